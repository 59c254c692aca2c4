"""The identity of a node (0x1018), checked before anything is written to it. Off the control path."""

from __future__ import annotations

from dataclasses import dataclass

from servod.common.errors import Unreachable
from servod.formats.config import Identity
from servod.runtime.fieldbus.cia import Obj301
from servod.runtime.fieldbus.devices import SdoAbort
from servod.runtime.fieldbus.master.sdo import NodeSdo

#: Sub-index of 0x1018 for each number that the configuration may state.
_SUBINDEX = {"vendor_id": 1, "product_code": 2, "revision": 3, "serial": 4}
_PROFILE_MASK = 0xFFFF


@dataclass(frozen=True, slots=True)
class NodeIdentity:
    """What a node says of itself; numbers that it does not have are None."""

    device_type: int
    vendor_id: int
    product_code: int | None
    revision: int | None
    serial: int | None

    @property
    def profile(self) -> int:
        """Number of the device profile: 402 for drives, 406 for encoders (low word of 0x1000)."""
        return self.device_type & _PROFILE_MASK


def read_identity(sdo: NodeSdo) -> NodeIdentity:
    """Read 0x1000 and 0x1018; only sub-index 1 is mandatory."""

    def optional(subindex: int) -> int | None:
        try:
            return sdo.read(Obj301.IDENTITY, subindex)
        except SdoAbort:
            return None

    return NodeIdentity(
        sdo.read(Obj301.DEVICE_TYPE), sdo.read(Obj301.IDENTITY, 1), optional(2), optional(3), optional(4)
    )


def check_identity(node_id: int, found: NodeIdentity, wanted: Identity, profile: int | None) -> None:
    """Raise Unreachable when the node is not the configured device, naming each number that differs."""
    wrong = [
        f"{name} (0x1018:{subindex}) is {_hex(getattr(found, name))}, configured is {_hex(getattr(wanted, name))}"
        for name, subindex in _SUBINDEX.items()
        if getattr(wanted, name) is not None and getattr(wanted, name) != getattr(found, name)
    ]
    if profile is not None and found.profile != profile:
        wrong.append(f"device profile (0x1000) is {found.profile}, the driver needs {profile}")
    if wrong:
        raise Unreachable(f"node {node_id} is another device: {'; '.join(wrong)}; nothing was written to it")


def _hex(value: int | None) -> str:
    return "absent" if value is None else f"0x{value:08X}"
