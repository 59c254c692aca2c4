"""Group of keys of the axis model file: what an identification measured, with 95 % intervals.

Physics does not read it; synthesis takes its vertices from here, reports print it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import Field, model_validator

from servod.common.yaml import Strict


class IdentifiedValue(Strict):
    """A number with its 95 % interval; `note` says what was hit or assumed."""

    value: float
    low: float
    high: float
    unit: str
    note: str = ""


class IdentifiedMap(Strict):
    """The friction map's half widths, node by node, of the 95 % interval."""

    velocities: list[float] = Field(min_length=2, max_length=512, description="rad/s, ascending")
    torques: list[float] = Field(min_length=2, max_length=512, description="N*m, with the velocity's sign")
    half_widths: list[float] = Field(min_length=2, max_length=512, description="N*m")

    @model_validator(mode="after")
    def _fits(self) -> IdentifiedMap:
        if not len(self.velocities) == len(self.torques) == len(self.half_widths):
            raise ValueError("as many torques and half_widths as velocities")
        return self


class DeviceIdentity(Strict):
    """What a node says of itself in 0x1018 (CiA 301); None: it does not say, or nobody asked."""

    vendor_id: int | None = Field(None, ge=0, le=0xFFFFFFFF, description="0x1018:1")
    product_code: int | None = Field(None, ge=0, le=0xFFFFFFFF, description="0x1018:2")
    serial: int | None = Field(None, ge=0, le=0xFFFFFFFF, description="0x1018:4")


class Devices(Strict):
    """Drive and encoder that something was measured with."""

    amplifier: DeviceIdentity = DeviceIdentity()
    encoder: DeviceIdentity = DeviceIdentity()

    @classmethod
    def of(cls, identities: Mapping[str, Mapping[str, Any] | None]) -> Devices:
        """Of what each role's node says; what it says besides is left out."""
        kept = {
            role: {key: found.get(key) for key in DeviceIdentity.model_fields}
            for role, found in identities.items()
            if found is not None
        }
        return cls.model_validate(kept)

    def differing(self, others: Devices) -> tuple[str, int, int] | None:
        """Key, own and other number of the first that both say and that differ; None where nothing differs."""
        for role in Devices.model_fields:
            mine, its = getattr(self, role), getattr(others, role)
            for key in DeviceIdentity.model_fields:
                own, other = getattr(mine, key), getattr(its, key)
                if own is not None and other is not None and own != other:
                    return f"{role}.{key}", own, other
        return None


class Identified(Strict):
    """Everything that was measured, by name, and what the experiments could not tell."""

    values: dict[str, IdentifiedValue]
    friction_map: IdentifiedMap
    not_identifiable: dict[str, str] = Field(default_factory=dict, description="what, and what would tell it")
    devices: Devices | None = Field(
        None, description="drive and encoder that it was measured with; a set made of it runs with these alone"
    )
    data_sha256: list[Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]] = Field(
        default_factory=list, description="hashes of the recordings' files that it was fitted on, in their order"
    )
