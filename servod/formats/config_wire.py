"""The part of the axis configuration that says what is on the wire: bus, cycle, heartbeats, amplifier and encoder.

Every key states its meaning, unit, sense and what holds when it is left out. servod.formats.config makes the whole file
of it.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from servod.common.yaml import Strict

NodeId = Annotated[int, Field(ge=1, le=127, description="CANopen node id, 1 to 127")]


class BusConfig(Strict):
    """How to reach the bus. `virtual`: channel is the hub's Unix socket; `socketcan`: an interface name; any other
    name goes to python-can with `options`."""

    interface: str = Field(
        "virtual", min_length=1, description="socketcan, virtual, or a name that python-can knows, e.g. pcan, kvaser"
    )
    channel: str = Field(
        "/run/servod/vbus0",
        min_length=1,
        description="socketcan: the network interface, e.g. can0; virtual: the hub's Unix socket; else python-can's",
    )
    bit_rate: Literal[10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 800_000, 1_000_000] = Field(
        1_000_000,
        description="what the bus load is reckoned with, and what python-can sets; a socketcan interface is set by the "
        "system (ip link, systemd-networkd), so state the same here",
    )
    max_load: float = Field(
        0.7,
        ge=0.01,
        le=0.95,
        description="share of the bit rate that the cyclic frames may use; with more the daemon does not start",
    )
    options: dict[str, Any] = Field(
        default_factory=dict, description="further arguments of python-can's Bus(); unused with socketcan and virtual"
    )


class CycleConfig(Strict):
    """The 1 kHz cycle and what it asks of the operating system."""

    period_us: int = Field(
        1000,
        ge=500,
        le=20_000,
        description="time from SYNC to SYNC; written to the drive (0x60C2), and what a certified gain set is bound to",
    )
    feedback_timeout_us: int = Field(
        600,
        ge=50,
        le=19_000,
        description="longest wait for both nodes' positions after SYNC, less than period_us; what has not come by then "
        "is stale in this cycle",
    )
    cpu: int | None = Field(
        None, ge=0, le=1023, description="core to pin the loop to, counted from 0; left out: the system chooses"
    )
    priority: int = Field(
        80, ge=0, le=98, description="SCHED_FIFO priority of the loop; 0 leaves the default scheduler"
    )

    @model_validator(mode="after")
    def _timeout_fits(self) -> CycleConfig:
        if self.feedback_timeout_us >= self.period_us:
            raise ValueError("cycle.feedback_timeout_us less than cycle.period_us")
        return self


class HeartbeatConfig(Strict):
    """Heartbeats both ways (CiA 301: 0x1016, 0x1017)."""

    master_node_id: NodeId = Field(
        126, description="node id under which servod sends its own heartbeat; of no device on the bus"
    )
    master_period_ms: int = Field(
        50, ge=10, le=1000, description="servod's heartbeat; the loop itself sends it, so it ends with the loop"
    )
    drive_timeout_ms: int = Field(
        150,
        ge=20,
        le=5000,
        description="without servod's heartbeat for this time the drive stops by itself (0x1016), the last line of "
        "defence; at least twice master_period_ms, and never written as more than twice: 100 ms with both left out",
    )
    command_deadline_ms: int | None = Field(
        None,
        ge=0,
        le=5000,
        description="without command frames for this time a drive that has 0x1400:5 stops by itself, or only tells: "
        "its quirks say which; at least two cycles; "
        "left out: as many cycles as limits.late_cycles, 5 ms at least, drive_timeout_ms at most; 0: not used, only "
        "the heartbeat guards",
    )
    node_period_ms: int = Field(50, ge=10, le=1000, description="heartbeat of drive and encoder, written to 0x1017")
    node_timeout_ms: int = Field(
        150,
        ge=20,
        le=5000,
        description="a node whose heartbeat stays away for longer is lost: quick stop (NODE_HEARTBEAT_LOST); at "
        "least twice node_period_ms",
    )

    @model_validator(mode="after")
    def _timeouts_exceed_periods(self) -> HeartbeatConfig:
        if self.drive_timeout_ms < 2 * self.master_period_ms:
            raise ValueError("heartbeat.drive_timeout_ms at least twice master_period_ms")
        if self.node_timeout_ms < 2 * self.node_period_ms:
            raise ValueError("heartbeat.node_timeout_ms at least twice node_period_ms")
        return self


class Identity(Strict):
    """Identity object 0x1018; every number that is given is checked before anything else is written."""

    vendor_id: int | None = Field(
        None,
        ge=0,
        le=0xFFFFFFFF,
        description="0x1018:1, the maker's number; another one ends the start-up; left out: any will do",
    )
    product_code: int | None = Field(
        None, ge=0, le=0xFFFFFFFF, description="0x1018:2; another one ends the start-up; left out: any will do"
    )
    revision: int | None = Field(
        None, ge=0, le=0xFFFFFFFF, description="0x1018:3; another one ends the start-up; left out: any will do"
    )
    serial: int | None = Field(
        None,
        ge=0,
        le=0xFFFFFFFF,
        description="0x1018:4, one single device; another one ends the start-up; left out: any will do",
    )


InputBit = Annotated[int, Field(ge=0, le=31)]
_LEVEL = "level of the bit that means stop; low: a broken wire stops, too; high: a broken wire is not seen"


class InputsConfig(Strict):
    """Digital inputs of the drive (0x60FD) that servod acts on; the numbers of the bits are in the drive's manual."""

    estop_bit: InputBit | None = Field(
        None, description="bit of 0x60FD that the emergency stop works on: quick stop, then off; left out: none is read"
    )
    estop_active: Literal["low", "high"] = Field("low", description=_LEVEL)
    sto_bit: InputBit | None = Field(
        None, description="bit of 0x60FD that shows the STO circuit: an axis that it stops says so; left out: none"
    )
    sto_active: Literal["low", "high"] = Field("low", description=_LEVEL)
    sto_error: int | None = Field(
        None,
        ge=1,
        le=0xFFFF,
        description="error code (0x603F, EMCY) by which the drive itself tells of STO, see its manual; left out: none",
    )

    @property
    def reports_sto(self) -> bool:
        """Something says whether STO took the torque."""
        return self.sto_bit is not None or self.sto_error is not None

    @model_validator(mode="after")
    def _bits_differ(self) -> InputsConfig:
        if self.estop_bit is not None and self.estop_bit == self.sto_bit:
            raise ValueError("different bits for amplifier.inputs.estop_bit and amplifier.inputs.sto_bit")
        return self


class BrakeConfig(Strict):
    """The holding brake, and who sequences it."""

    by: Literal["none", "drive", "output"] = Field(
        "none",
        description="none: no brake; drive: the drive opens and closes it by itself, servod waits for it; output: "
        "servod does by an output of the drive (0x60FE)",
    )
    output_bit: int | None = Field(
        None, ge=0, le=31, description="by output: bit of 0x60FE:1, which 0x60FE:2 gives to servod; else left out"
    )
    output_engages: Literal["low", "high"] = Field(
        "low",
        description="level of the bit that closes it; low: it closes too when the drive resets its outputs",
    )
    release_s: float = Field(
        0.1,
        ge=0.0,
        le=5.0,
        description="from the release until it is open; so long the axis holds, not yet ENABLED",
    )
    engage_s: float = Field(
        0.1,
        ge=0.0,
        le=5.0,
        description="until it is closed; so long the torque stays, where the drive still gives any",
    )

    @model_validator(mode="after")
    def _output_has_a_bit(self) -> BrakeConfig:
        if (self.by == "output") != (self.output_bit is not None):
            raise ValueError("amplifier.brake.output_bit with amplifier.brake.by: output, and only then")
        return self


#: 0x605A from here on: the ramp of 4 less, and then quick stop active is kept, with torque.
QUICK_STOP_STAYS = 5


def quick_stop_stays(quick_stop_option: int) -> bool:
    """Whether the drive stays in quick stop active (0x605A is 5 to 8) and may go back by transition 16."""
    return quick_stop_option >= QUICK_STOP_STAYS


class AmplifierConfig(Strict):
    """The servo amplifier. Positions of 0x6064 are counts of the motor encoder; the joint turns 1/gear_ratio of it."""

    driver: str = Field("cia402", min_length=1, description="device driver by name; cia402 is the profile's")
    node_id: NodeId = Field(1, description="CANopen node id of the drive")
    eds: str | None = Field(None, description="EDS or DCF file; left out: the driver's generic dictionary")
    identity: Identity = Identity()
    quirks: str | None = Field(
        None,
        description="row of the quirks table, e.g. epos4, elmo, copley, nanotec, technosoft; left out: virtual on the "
        "virtual bus, else none",
    )
    counts_per_turn: int = Field(
        1_048_576,
        ge=4,
        le=2**32 - 1,
        description="counts of 0x6064 in one turn of the motor shaft, before the gear: lines times four, or 2^bits",
    )
    gear_ratio: float = Field(
        1.0,
        ge=1e-6,
        le=1e6,
        description="turns of the motor for one turn of the joint: 100 for a 100:1 reducer, 1 for a direct drive; "
        "joint angle = motor angle / gear_ratio, joint torque = motor torque * gear_ratio, without losses",
    )
    position_direction: Literal[1, -1] = Field(
        1, description="-1 where 0x6064 falls while the joint's encoder, with encoder.direction, rises"
    )
    torque_direction: Literal[1, -1] = Field(
        1, description="-1 where a positive 0x6071 turns the joint so that its position falls; on top of 0x607E"
    )
    rated_torque_mnm: int | None = Field(
        None,
        ge=1,
        description="rated torque of the motor, before the gear, as 0x6076 must read; left out: what it reads counts",
    )
    quick_stop_option: Literal[0, 1, 2, 3, 4, 5, 6, 7, 8] = Field(
        2,
        description="0x605A, how the drive stops: 0 torque off, 1 its slow-down ramp, 2 its quick-stop ramp, 3 current "
        "limit, 4 voltage limit, each then off; 5 to 8 the same as 1 to 4, then holding with torque",
    )
    heartbeat_reaction: Literal[1, 2, 3] = Field(
        3,
        description="0x6007, when servod's heartbeat stays away: 1 fault, 2 disable voltage, 3 quick stop; 1 is "
        "written where a quick stop would hold for ever (quick_stop_option from 5 on, no brake by output)",
    )
    unguarded: bool = Field(
        False,
        description="run a drive that does not stop by itself when servod is dead (neither 0x6007 nor a command "
        "deadline), or whose way to stop cannot be set (0x605A, 0x605E): shown in every status; only where "
        "nobody can be hurt",
    )
    guard_test_days: float | None = Field(
        None,
        ge=0.01,
        le=3650.0,
        description="`enable` asks for a proof by `servoctl guard-test` that the drive stops by itself in time, no "
        "older than this; another drive, guard or time needs a new one; left out: none is asked for",
    )
    enable_timeout_s: float = Field(
        2.0,
        ge=1e-3,
        le=60.0,
        description="longest time to power up, beyond: ENABLE_TIMEOUT; and longest wait for the drive's own quick stop",
    )
    inputs: InputsConfig = InputsConfig()
    brake: BrakeConfig = BrakeConfig()


class EncoderConfig(Strict):
    """The joint's encoder and how its velocity is made."""

    driver: str = Field("cia406", min_length=1, description="device driver by name; cia406 is the profile's")
    node_id: NodeId = Field(2, description="CANopen node id of the encoder")
    eds: str | None = Field(None, description="EDS or DCF file; left out: the driver's generic dictionary")
    identity: Identity = Identity()
    counts_per_turn: int = Field(
        1_048_576,
        ge=4,
        le=2**32 - 1,
        description="counts in one turn of the joint; 0x6001, or 0x6501 without scaling, must read the same",
    )
    measuring_range_counts: int | None = Field(
        None, ge=4, le=2**32, description="where the counter wraps, as 0x6002 must read; left out: what it reads counts"
    )
    direction: Literal[1, -1] = Field(1, description="-1 where the counter falls while the joint turns as positive")
    zero_offset_rad: float = Field(
        0.0, ge=-1e6, le=1e6, description="what the encoder reads, with direction, where the joint is to be at 0 rad"
    )
    velocity_cutoff_hz: float = Field(
        120.0,
        ge=0.1,
        le=2000.0,
        description="first-order low-pass of the velocity; a certified gain set is bound to its own",
    )
