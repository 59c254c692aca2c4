"""The axis configuration file: everything about bus, nodes, limits and services of one axis. Gains live elsewhere.

Every key has its unit in its name, its range and its meaning here; an unknown key is an error (servod.common.yaml). The
daemon, the command line and the virtual axis read the same file, the virtual axis only for node ids and bus. What is on
the wire stands in servod.formats.config_wire; `servoctl config keys` prints every key.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import Field, model_validator

from servod.common.yaml import Strict
from servod.formats.config_wire import (
    AmplifierConfig,
    BrakeConfig,
    BusConfig,
    CycleConfig,
    EncoderConfig,
    HeartbeatConfig,
    Identity,
    InputsConfig,
    NodeId,
)
from servod.formats.gains.signature import is_key
from servod.formats.kinds import FileKind, load_kind

__all__ = [
    "AmplifierConfig",
    "AxisConfig",
    "BrakeConfig",
    "BusConfig",
    "ControlConfig",
    "CycleConfig",
    "EncoderConfig",
    "GainsConfig",
    "HeartbeatConfig",
    "Identity",
    "InputsConfig",
    "LimitsConfig",
    "MetricsConfig",
    "NodeId",
    "RecorderConfig",
    "StoppingConfig",
    "WiringProofConfig",
    "load_config",
]

#: The test of the wiring stays below the limits by this share where its own bounds are not stated.
_PROOF_SHARE = 0.9
#: What it needs besides a ramp each way: at rest, holding, coming to rest [s].
_PROOF_RESTS_S = 0.1
#: The deadline of the commands is in whole ms, and one frame that is late by a few is no dead master.
_LEAST_DEADLINE_MS = 5


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
    torque_mismatch_nm: float | None = Field(
        None,
        ge=1e-6,
        le=1e5,
        description="most distance of the torque that the drive says it gives (0x6077) and what it was told; beyond "
        "for 50 cycles: quick stop (TORQUE_IMPLAUSIBLE); left out: a quarter of torque_nm",
    )
    oscillation_nm: float | None = Field(
        None,
        ge=1e-6,
        le=1e6,
        description="peak-to-peak torque that counts as a swing; 6 that the reference does not ask for, of which one "
        "in two seconds is forgotten: quick stop (OSCILLATES); left out: torque_nm, or what the way to rest leaves a "
        "joint at rest of it; twice torque_nm: never",
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


class StoppingConfig(Strict):
    """The worst joint that a stop is reckoned with (servod.formats.stopping); left out: what `model` says, or else the
    design of the first gain set, or else wiring_proof.inertia with half of its friction_nm and no load."""

    least_inertia: float | None = Field(
        None, ge=1e-12, le=1e6, description="of all that moves, without load; none: 0.9 of the model's"
    )
    most_inertia: float | None = Field(
        None, ge=1e-12, le=1e6, description="with the greatest load; none: 1.1 of the model's"
    )
    least_friction_nm: float | None = Field(
        None, ge=0.0, le=1e5, description="dry friction that is always there, warm and run in; none: half the model's"
    )
    least_viscous: float | None = Field(
        None, ge=0.0, le=1e5, description="viscous friction that is always there; none: half the model's"
    )
    load_min_nm: float | None = Field(
        None,
        ge=-1e5,
        le=0.0,
        description="load on the joint the negative way, e.g. a weight; none: the model's gravity",
    )
    load_max_nm: float | None = Field(
        None, ge=0.0, le=1e5, description="load on the joint the positive way; none: the model's gravity"
    )
    deceleration_rad_s2: float | None = Field(
        None,
        ge=1e-3,
        le=1e7,
        description="ramp of the drive's quick stop at the joint, written to 0x6085 (option 1: 0x6084) unless it is "
        "steeper there; none: 0.8 of what limits.torque_nm can do with the most inertia and load",
    )
    drive_lag_s: float = Field(
        0.006, ge=0.0, le=1.0, description="the drive's own velocity control follows its ramp so much later"
    )
    within_s: float | None = Field(
        None,
        ge=0.005,
        le=60.0,
        description="torque is gone so long after a loss of the master, braking included; where a brake or 0x605A from "
        "5 on holds the joint on purpose, it is at rest by then, and the torque gone later (status: stopping.held_s); "
        "limits.speed_rad_s is narrowed until it is; none: 0.06 s, or 0.3 s where the drive reacts to its commands "
        "later than 0.03 s",
    )


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
        False,
        description="run gain sets that carry no certificate, and those of another drive or encoder; one whose "
        "certificate says no, or is broken, never runs",
    )
    signers: list[str] = Field(
        default_factory=list,
        max_length=100,
        description="run only sets that one of these public Ed25519 keys has signed (`servoctl verify --sign`): each a "
        "line of OpenSSH, or a file of such lines or PEM (extra `sign`); none: hashes alone, against accidents",
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
    stopping: StoppingConfig = StoppingConfig()
    gains: GainsConfig
    model: Path | None = Field(
        None,
        description="axis model: what the test of the wiring expects and what a stop is reckoned with, the delay that "
        "a gain set must be designed for, attached to every recording; left out: none of these",
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
    def _deadline_fits_cycle(self) -> AxisConfig:
        if 0 < 1000 * (self.heartbeat.command_deadline_ms or 0) < 2 * self.cycle.period_us:
            raise ValueError("heartbeat.command_deadline_ms 0, or at least twice cycle.period_us")
        return self

    @property
    def quirks(self) -> str:
        """Row of the quirks table (drivers/quirks.py)."""
        return self.amplifier.quirks or ("virtual" if self.bus.interface == "virtual" else "none")

    @property
    def command_deadline_ms(self) -> int:
        """Deadline of the command frames in the drive (0x1400:5), in ms; 0: none is wanted."""
        if self.heartbeat.command_deadline_ms is not None:
            return self.heartbeat.command_deadline_ms
        # The loop itself stops the axis when it was late for so long: the drive need not wait any longer for it.
        budget_ms = max(-(-self.limits.late_cycles * self.cycle.period_us // 1000), _LEAST_DEADLINE_MS)
        return min(max(budget_ms, 2 * -(-self.cycle.period_us // 1000)), self.heartbeat.drive_timeout_ms)

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
    signers = [one if is_key(one) else str(base / one) for one in config.gains.signers]
    changed["gains"] = changed["gains"].model_copy(update={"signers": signers})
    return config.model_copy(update=changed)


def _beside(base: Path, path: str | Path | None) -> str | Path | None:
    """A path from the file as seen from anywhere; what the model keeps as text stays text."""
    if path is None:
        return None
    return str(base / path) if isinstance(path, str) else base / path
