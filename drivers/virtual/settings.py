"""Settings of a virtual axis: nodes, sensors, bus. What the joint itself is like stands in an axis model file.

Read by the virtual world from its command line or a YAML file; the master never sees them.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from servod.common.yaml import Strict
from servod.formats.config import NodeId


class VirtualAxisSettings(Strict):
    """One virtual axis. The rated torque of 100 mN*m makes one per mille of 0x6071 a step of 0.1 mN*m, fine enough
    against 45 mN*m of friction; 300 per cent of it is the drive's maximum."""

    amplifier_node_id: NodeId = 1
    encoder_node_id: NodeId = 2
    amplifier_serial: int = Field(1, ge=0, le=0xFFFFFFFF, description="0x1018:4 of the amplifier")
    encoder_serial: int = Field(2, ge=0, le=0xFFFFFFFF, description="0x1018:4 of the encoder")
    rated_torque_mnm: int = Field(100, ge=1, le=100_000_000, description="0x6076; 0x6071 is in per mille of it")
    max_torque_permille: int = Field(3000, ge=1, le=32767, description="0x6072: the drive itself gives no more")
    amplifier_counts_per_turn: int = Field(1_048_576, ge=4, le=2**32 - 1, description="of the motor")
    gear_ratio: float = Field(1.0, ge=1e-6, le=1e6, description="turns of the motor for one turn of the joint")
    polarity: int = Field(0, ge=0, le=0xE0, description="0x607E as stored in the drive; 0x20 turns round the torque")
    encoder_counts_per_turn: int = Field(1_048_576, ge=4, le=2**32 - 1, description="of the joint")
    encoder_measuring_range_counts: int = Field(2**31, ge=4, le=2**32 - 1, description="0x6002; any number")
    encoder_direction: Literal[1, -1] = Field(1, description="-1: mounted the other way round")
    encoder_noise_counts: float = Field(0.0, ge=0.0, le=1e6, description="standard deviation of a reading")
    brake: Literal["none", "output", "drive"] = Field(
        "none", description="holding brake on the joint: by bit 16 of 0x60FE:1, or sequenced by the drive itself"
    )
    brake_nm: float = Field(1.0, ge=0.0, le=1e6, description="what the closed brake holds")
    brake_release_s: float = Field(0.05, ge=0.0, le=5.0, description="from the release until it is open")
    brake_engage_s: float = Field(0.05, ge=0.0, le=5.0, description="from the command until it is closed")
    start_position_rad: float = Field(0.0, description="of the joint at power-on")
    cycle_period_s: float = Field(0.001, ge=1e-5, le=0.1, description="part of the model's delay that SYNC costs")
    command_deadline: Literal["stops", "tells", "none"] = Field(
        "stops",
        description="0x1400:5: the drive stops by 0x6007 and 0x1029, sends EMCY 0x8250 alone, or has none",
    )
    missing_objects: list[Annotated[str, Field(pattern=r"^[0-9A-F]{4}(:[0-9A-F]{1,2})?$")]] = Field(
        [],
        description="objects, or sub-indices, that the amplifier does not have, in hexadecimal: 6007, 1400:5",
    )
    bit_rate: Literal[10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 800_000, 1_000_000] = Field(
        1_000_000, description="bit/s of the modelled bus"
    )
    queue_depth: int = Field(64, ge=1, le=10_000, description="transmit queue of each client, in frames")
    client_restart_ms: int = Field(0, ge=0, le=60_000, description="a client's return from bus-off; 0: never")
    node_restart_ms: int = Field(100, ge=0, le=60_000, description="the nodes' return from bus-off; 0: never")
    seed: int = Field(1, ge=0, le=2**63 - 1, description="of all noise: the same number, the same noise")

    @model_validator(mode="after")
    def _node_ids_differ(self) -> VirtualAxisSettings:
        if self.amplifier_node_id == self.encoder_node_id:
            raise ValueError("different ids for amplifier_node_id and encoder_node_id")
        return self
