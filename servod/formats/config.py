"""The axis configuration file: everything about bus, nodes, limits and services of one axis. Gains live elsewhere.

Every key has its unit in its name, its range and its meaning here; an unknown key is an error (servod.common.yaml). The
daemon, the command line and the virtual axis read the same file, the virtual axis only for node ids and bus. What is on
the wire stands in servod.formats.config; `servoctl config keys` prints every key.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from servod.common.yaml import Strict
from servod.formats.kinds import FileKind, load_kind

# --- What is on the wire ---------------------------------------------------------------------------------------------
# The part of the axis configuration that says what is on the wire: bus, cycle, heartbeats, amplifier and encoder. Every
# key states its meaning, unit, sense and what holds when it is left out: `servoctl config keys` prints them.


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
        "defence; also the deadline of the torque commands; at least twice master_period_ms",
    )
    node_period_ms: int = Field(50, ge=10, le=1000, description="heartbeat of drive and encoder, written to 0x1017")
    node_timeout_ms: int = Field(
        150,
        ge=20,
        le=5000,
        description="a node whose heartbeat stays away for longer is lost: disabled (NODE_HEARTBEAT_LOST); at "
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


class AmplifierConfig(Strict):
    """The servo amplifier. Positions of 0x6064 are counts of the motor encoder; the joint turns 1/gear_ratio of it."""

    driver: str = Field("cia402", min_length=1, description="device driver by name; cia402 is the profile's")
    node_id: NodeId = Field(1, description="CANopen node id of the drive")
    eds: str | None = Field(None, description="EDS or DCF file; left out: the driver's generic dictionary")
    identity: Identity = Identity()
    quirks: str = Field("none", description="row of the quirks table, e.g. epos4, elmo, copley, nanotec, technosoft")
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
        3, description="0x6007, when servod's heartbeat stays away: 1 fault, 2 disable voltage, 3 quick stop"
    )
    enable_timeout_s: float = Field(
        2.0,
        ge=1e-3,
        le=60.0,
        description="longest time to power up, beyond: ENABLE_TIMEOUT; and longest wait for the drive's own quick stop",
    )


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


__all__ = [
    "AmplifierConfig",
    "AxisConfig",
    "BusConfig",
    "ControlConfig",
    "CycleConfig",
    "EncoderConfig",
    "GainsConfig",
    "HeartbeatConfig",
    "Identity",
    "LimitsConfig",
    "MetricsConfig",
    "NodeId",
    "RecorderConfig",
    "WiringProofConfig",
    "load_config",
]

#: The test of the wiring stays below the limits by this share where its own bounds are not stated.
_PROOF_SHARE = 0.9
#: What it needs besides a ramp each way: at rest, holding, coming to rest [s].
_PROOF_RESTS_S = 0.1


class LimitsConfig(Strict):
    """The independent last layer before the wire (servod.runtime.loop.limits)."""

    torque_nm: float = Field(
        ge=1e-6,
        le=1e5,
        description="most torque at the joint, after the gear, either way; more is cut (TORQUE_CLIPPED)",
    )
    torque_rate_nm_per_s: float = Field(
        ge=1e-6, le=1e9, description="fastest change of the torque; a faster one is slowed (TORQUE_RATE_CLIPPED)"
    )
    speed_rad_s: float = Field(
        ge=1e-6, le=1e5, description="most speed of the joint either way; beyond: quick stop (SPEED_LIMIT)"
    )
    position_min_rad: float = Field(
        ge=-1e6, le=1e6, description="least position of the joint, in the encoder's zero; beyond: quick stop"
    )
    position_max_rad: float = Field(
        ge=-1e6,
        le=1e6,
        description="greatest position, more than position_min_rad; beyond: quick stop (POSITION_LIMIT)",
    )
    following_error_rad: float = Field(
        ge=1e-9, le=1e6, description="most distance of position and reference; beyond: ramp-down (FOLLOWING_ERROR)"
    )
    encoder_mismatch_rad: float = Field(
        ge=1e-9,
        le=1e6,
        description="most distance that drive's and encoder's position of the joint may drift apart since the enable; "
        "beyond: disabled (ENCODER_IMPLAUSIBLE)",
    )
    stale_cycles: int = Field(
        5, ge=1, le=1000, description="cycles in a row without fresh feedback; as many: quick stop (FEEDBACK_STALE)"
    )
    late_cycles: int = Field(
        20,
        ge=1,
        le=10_000,
        description="skipped periods, more: quick stop (DEADLINE_BUDGET); 20 punctual cycles make up for one",
    )
    ramp_down_s: float = Field(
        0.05,
        ge=1e-4,
        le=1.0,
        description="time in which a ramp-down takes the torque to zero; a disable brakes for at most as long before",
    )

    @model_validator(mode="after")
    def _range_is_a_range(self) -> LimitsConfig:
        if self.position_min_rad >= self.position_max_rad:
            raise ValueError("limits.position_min_rad less than limits.position_max_rad")
        return self


class WiringProofConfig(Strict):
    """The bounded test of polarity, scale and directions before the first torque
    (servod.runtime.loop.wiring.wiring_test)."""

    enabled: bool = Field(True, description="prove at the first enable after a start, and after what makes it doubtful")
    torque_nm: float | None = Field(
        None,
        ge=1e-6,
        le=1e5,
        description="most torque; none: 0.9 of limits.torque_nm, or 15 times what friction_nm and inertia lead to "
        "expect and 0.075 of limits.torque_nm, if that is less",
    )
    ramp_s: float = Field(0.2, ge=0.05, le=10.0, description="from next to no torque to the most, exponentially")
    travel_rad: float | None = Field(
        None, ge=1e-9, le=1.0, description="a motion; none: 0.001 rad, or more where the sensors need it"
    )
    most_travel_rad: float | None = Field(
        None, ge=1e-9, le=1.0, description="further fails; none: 0.05 rad, or 100 counts of the encoder if that is more"
    )
    speed_rad_s: float | None = Field(
        None, ge=1e-6, le=1e5, description="faster fails; none: 0.9 of limits.speed_rad_s"
    )
    timeout_s: float = Field(
        5.0, ge=0.5, le=60.0, description="the whole test; longer fails; at least twice ramp_s and 0.1 s"
    )
    friction_nm: float | None = Field(
        None, ge=0.0, le=1e5, description="expected at break-away, 0 for a free joint; none: what `model` says"
    )
    inertia: float | None = Field(None, ge=1e-12, le=1e6, description="expected, kg*m^2; none: what `model` says")

    @model_validator(mode="after")
    def _both_ways_fit(self) -> WiringProofConfig:
        if self.timeout_s < 2.0 * self.ramp_s + _PROOF_RESTS_S:
            raise ValueError(f"wiring_proof.timeout_s at least twice ramp_s, and {_PROOF_RESTS_S:g} s of rests")
        if self.travel_rad and self.most_travel_rad and self.travel_rad > self.most_travel_rad:
            raise ValueError("wiring_proof.travel_rad at most most_travel_rad")
        return self


class GainsConfig(Strict):
    """Where gain sets are kept and which one is active at start."""

    directory: Path = Field(Path("/var/lib/servod/gains"), description="where versions and the active set are kept")
    initial: Path = Field(description="gain set of the first start; later the one that was activated last counts")
    max_versions: int = Field(
        100,
        ge=1,
        le=100_000,
        description="of each set the oldest beyond this are removed, but the active and those before",
    )
    accept_uncertified: bool = Field(
        False, description="run gain sets that carry no certificate; one that says no, or is broken, never runs"
    )


class ControlConfig(Strict):
    """The control socket: whose members of which group may command (root always may)."""

    socket: Path = Field(
        Path("/run/servod/axis.sock"), description="Unix socket that the daemon takes commands on; --socket of servoctl"
    )
    group: str = Field("servod", description="members of this group of the system may command, and root")


class RecorderConfig(Strict):
    """Recordings and the history kept before a fault."""

    directory: Path = Field(Path("/var/lib/servod/recordings"), description="where recordings and fault files go")
    history_s: float = Field(10.0, ge=0.0, le=600.0, description="kept in memory, written to a file at a fault")
    always: bool = Field(False, description="record from the daemon's start to its stop")
    max_file_mib: int = Field(1024, ge=1, le=1_048_576, description="a recording that is larger goes on in a new file")
    max_fault_files: int = Field(50, ge=1, le=100_000, description="the oldest fault files beyond this are removed")
    max_total_mib: int = Field(
        20_480,
        ge=4,
        le=1_000_000_000,
        description="most of recordings and fault files together; the oldest recordings make room, no fault file does. "
        "Recordings with a name of your own are neither counted nor removed",
    )
    max_age_days: float | None = Field(
        None, ge=0.01, le=36_500.0, description="recordings not touched for so long are removed; left out: none is"
    )


class MetricsConfig(Strict):
    """Prometheus metrics: a local HTTP port, a textfile for the node exporter, both or none."""

    http_port: int | None = Field(None, ge=1, le=65535, description="TCP port of the metrics; left out: none is opened")
    http_address: str = Field("127.0.0.1", description="address that http_port listens on; 0.0.0.0: all of the machine")
    textfile: Path | None = Field(
        None, description="file for the node exporter's textfile collector, *.prom; left out: none is written"
    )


class AxisConfig(Strict):
    """One axis: the whole configuration file."""

    name: str = Field(
        "axis",
        pattern=r"^[A-Za-z0-9_.-]{1,64}$",
        description="name of the axis: in the status, as a label of the metrics, and in front of its recordings' names",
    )
    bus: BusConfig = BusConfig()
    cycle: CycleConfig = CycleConfig()
    heartbeat: HeartbeatConfig = HeartbeatConfig()
    amplifier: AmplifierConfig = AmplifierConfig()
    encoder: EncoderConfig = EncoderConfig()
    limits: LimitsConfig
    wiring_proof: WiringProofConfig = WiringProofConfig()
    gains: GainsConfig
    model: Path | None = Field(
        None,
        description="axis model: friction and inertia that the test of the wiring expects, the delay that a gain set "
        "must be designed for, attached to every recording; left out: none of these",
    )
    control: ControlConfig = ControlConfig()
    recorder: RecorderConfig = RecorderConfig()
    metrics: MetricsConfig = MetricsConfig()

    @model_validator(mode="after")
    def _node_ids_differ(self) -> AxisConfig:
        ids = (self.heartbeat.master_node_id, self.amplifier.node_id, self.encoder.node_id)
        if len(set(ids)) != len(ids):
            raise ValueError("different ids for heartbeat.master_node_id, amplifier.node_id and encoder.node_id")
        return self

    @model_validator(mode="after")
    def _proof_fits_limits(self) -> AxisConfig:
        proof, limits = self.wiring_proof, self.limits
        if proof.torque_nm is not None and proof.torque_nm > limits.torque_nm:
            raise ValueError("wiring_proof.torque_nm at most limits.torque_nm")
        if proof.speed_rad_s is not None and proof.speed_rad_s > limits.speed_rad_s:
            raise ValueError("wiring_proof.speed_rad_s at most limits.speed_rad_s")
        most_nm = self.most_proof_nm
        if proof.friction_nm is not None and proof.friction_nm >= most_nm:
            raise ValueError(f"wiring_proof.friction_nm less than the {most_nm:.3g} N*m that the test may use")
        return self

    @property
    def most_proof_nm(self) -> float:
        """The largest torque that the test of the wiring may use."""
        return self.wiring_proof.torque_nm or _PROOF_SHARE * self.limits.torque_nm


#: Keys that name a file or folder, by section; `bus.channel` names one only on the virtual bus.
_PATHS: dict[str, tuple[str, ...]] = {
    "amplifier": ("eds",),
    "encoder": ("eds",),
    "gains": ("directory", "initial"),
    "control": ("socket",),
    "recorder": ("directory",),
    "metrics": ("textfile",),
}


def load_config(path: str | Path) -> AxisConfig:
    """Read and check an axis configuration; every relative path inside is relative to the file. Raises BadInput."""
    config = load_kind(path, FileKind.AXIS, AxisConfig)
    base = Path(path).resolve().parent
    paths = _PATHS | ({"bus": ("channel",)} if config.bus.interface == "virtual" else {})
    changed: dict[str, Any] = {"model": _beside(base, config.model)}
    for name, keys in paths.items():
        section = getattr(config, name)
        changed[name] = section.model_copy(update={key: _beside(base, getattr(section, key)) for key in keys})
    return config.model_copy(update=changed)


def _beside(base: Path, path: str | Path | None) -> str | Path | None:
    """A path from the file as seen from anywhere; what the model keeps as text stays text."""
    if path is None:
        return None
    return str(base / path) if isinstance(path, str) else base / path
