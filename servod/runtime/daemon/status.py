"""The status document: state, goal, reasons and health of the axis in one dictionary, as `status` and `watch` give it.

Around the loop: reads the newest cycle record and what the supervisor knows. Enums become their names here and faults
their rows of the fault table, so that readers need no tables of their own.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple, TypedDict

from servod.common.faults import FAULTS, Fault, FaultCode, faults_in
from servod.common.units import NS_PER_S
from servod.formats.config import AxisConfig, BrakeConfig, BusConfig, InputsConfig
from servod.formats.recording.record import CycleRecord
from servod.formats.stopping import StoppingStatus
from servod.runtime.daemon.guard_test import GuardTestStatus
from servod.runtime.daemon.promise import PromiseStatus
from servod.runtime.daemon.recorder import RecorderState
from servod.runtime.fieldbus.devices import NEVER_CYCLES, REASON_TEXT, DriveState, Goal, Reason
from servod.runtime.loop.axis_state import AxisState

#: A loop that writes its record in every cycle, read every 20 ms, is stale after this time.
_RECORD_STALE_S = 0.2


class Age(TypedDict):
    """How long ago the values beside it were heard, in s; None is never. What is `stale` tells nothing of now."""

    age_s: float | None
    stale: bool


class AxisStatus(TypedDict):
    """What the axis is, what it shall be, and why it is not there yet."""

    state: str
    goal: str
    goal_reached: bool
    reasons: list[str]
    motion_running: bool


class DriveStatus(Age):
    """The amplifier as its status word and error code say, and how old that is; ages in cycles too."""

    state: str
    status_word: str
    mode: int
    error_code: str
    feedback_age_cycles: int
    encoder_age_cycles: int


class InputStatus(TypedDict):
    """One input of the drive that the axis acts on; `active`: it stops the axis, or is not heard any more."""

    name: str
    active: bool


class BrakeStatus(TypedDict):
    """The holding brake: who sequences it (none, drive, output), and what it is told or expected to do."""

    by: str
    state: str


class MotionStatus(Age):
    """Positions in rad, velocity in rad/s, torques in N*m, all at the joint; None is not finite (JSON has no NaN).

    The age is that of the encoder's feedback: position, velocity, following error. The drive's own position and torque
    (`motor_position_rad`, `torque_actual_nm`) are as old as the drive's status, everything else as the loop's.
    `abandoned` says why the last motion ended before its time, when its client let go of it; empty otherwise.
    """

    reference_rad: float | None
    position_rad: float | None
    following_error_rad: float | None
    velocity_rad_s: float | None
    motor_position_rad: float | None
    torque_nm: float | None
    torque_actual_nm: float | None
    torque_feedback_nm: float | None
    torque_friction_nm: float | None
    torque_other_nm: float | None
    friction_state_rad: float | None
    disturbance_nm: float | None
    abandoned: str


class FaultStatus(TypedDict):
    """One latched fault with its row of the fault table; `present` when its cause still stands."""

    code: str
    present: bool
    reaction: str
    cause: str
    remedy: str


class Percentiles(TypedDict):
    """Distribution over the last seconds, in microseconds."""

    p50_us: float
    p99_us: float
    max_us: float


class TimingStatus(TypedDict):
    """How the loop keeps time: `lag` wake-up after the deadline, `tick` its work, `torque` deadline to torque frame."""

    period_us: int
    window_s: float
    cycle: int
    missed: int
    records_lost: int
    lag: Percentiles
    tick: Percentiles
    torque: Percentiles


class ControllerStatus(TypedDict):
    """The active gain set; `note` says why it is not the one that was active last, empty where it is."""

    serial: int
    name: str
    law: str
    note: str


class BusStatus(TypedDict):
    """The bus as configured and as it does; `load` is the computed share of the bit rate."""

    interface: str
    channel: str
    load: float
    max_load: float
    queue_full: int
    error_frames: int
    late_frames: int
    ignored_frames: int


class IdentityStatus(TypedDict):
    """What a node said of itself at the start (0x1018); None what it does not have."""

    vendor_id: int
    product_code: int | None
    revision: int | None
    serial: int | None


class NodeStatus(Age):
    """One node and the state that its last heartbeat told; the age is that heartbeat's."""

    node_id: int
    role: str
    driver: str
    state: str
    identity: IdentityStatus | None


class GuardStatus(TypedDict):
    """How the drive guards itself: how soon it stops without a master, how often its guards are read again, and their
    proof (servod.runtime.daemon.guard_test.GuardTestStatus)."""

    unguarded: bool
    reaction_ms: int
    command_deadline_ms: int
    heartbeat_timeout_ms: int
    most_torque_nm: float | None
    watched: int
    proof: GuardTestStatus


class GrantStatus(TypedDict):
    """One thing asked of the operating system for real time, and whether it was given."""

    name: str
    granted: bool
    reason: str


class LoopStatus(Age):
    """The loop process; the age is that of its newest cycle, from which all of the status comes but nodes and lease."""

    pid: int


class LeaseStatus(TypedDict):
    """The client that commands, pid 0 when none does; and the process that stopped its axis, 0 when none did."""

    pid: int
    uid: int
    stopped_by: int


class WiringStatus(TypedDict):
    """Tests of the wiring since the start; `last` is servod.runtime.loop.wiring.findings.wiring_document, None before
    the
    first enable."""

    tests: int
    last: dict[str, Any] | None


class Status(TypedDict):
    """The whole document; `stopping` is servod.formats.stopping.Stopping's, None where nothing tells of the joint."""

    name: str
    version: str
    uptime_s: float
    axis: AxisStatus
    drive: DriveStatus
    inputs: list[InputStatus]
    brake: BrakeStatus
    motion: MotionStatus
    faults: list[FaultStatus]
    wiring: WiringStatus
    stopping: StoppingStatus | None
    controller: ControllerStatus
    promise: PromiseStatus
    loop: LoopStatus
    timing: TimingStatus
    bus: BusStatus
    nodes: list[NodeStatus]
    guards: GuardStatus
    grants: list[GrantStatus]
    recorder: RecorderState
    lease: LeaseStatus


_BRAKE = dict.fromkeys(AxisState, "closed") | {
    AxisState.PROVING: "open",
    AxisState.RELEASING: "opening",
    AxisState.ENABLED: "open",
    AxisState.BRAKING: "open",
    AxisState.ENGAGING: "closing",
    AxisState.QUICK_STOPPING: "closing at rest",
}
#: The drive has its power; the axis is not there yet.
_BEFORE = {AxisState.PROVING: "the wiring is being tested", AxisState.RELEASING: "the brake opens"}


def axis_status(record: CycleRecord) -> AxisStatus:
    """State, goal and reasons of one cycle."""
    before = [text for state, text in _BEFORE.items() if state == record.axis_state]
    return {
        "state": AxisState(record.axis_state).name,
        "goal": Goal(record.goal).name,
        "goal_reached": bool(record.goal_reached) and not before,
        "reasons": before + reason_texts(record.reasons),
        "motion_running": bool(record.reference_active),
    }


def reason_texts(reasons: int) -> list[str]:
    """The sentences of the bits in `reasons` (servod.runtime.fieldbus.devices.Reason)."""
    return [text for bit, text in REASON_TEXT.items() if Reason(reasons) & bit]


class Freshness(NamedTuple):
    """How old what a cycle record tells is: the age of its feedback, and its own."""

    period_s: float
    stale_cycles: int
    record_age_s: float

    @classmethod
    def of(cls, config: AxisConfig, record: CycleRecord, now_ns: int) -> Freshness:
        """By the axis's period and limits.stale_cycles, at `now_ns` on the loop's clock (CLOCK_MONOTONIC)."""
        age_s = max(0, now_ns - record.time_ns) / NS_PER_S
        return cls(config.cycle.period_us * 1e-6, config.limits.stale_cycles, age_s)

    def record(self) -> Age:
        """The record itself."""
        return {"age_s": self.record_age_s, "stale": self.record_age_s > self._record_limit_s}

    def feedback(self, age_cycles: int) -> Age:
        """Feedback that was `age_cycles` old in the record: stale where the loop would stop an axis for it."""
        stale = age_cycles >= self.stale_cycles or self.record_age_s > self._record_limit_s
        never = age_cycles >= NEVER_CYCLES
        return {"age_s": None if never else age_cycles * self.period_s + self.record_age_s, "stale": stale}

    @property
    def _record_limit_s(self) -> float:
        return max(_RECORD_STALE_S, self.stale_cycles * self.period_s)


def drive_status(record: CycleRecord, fresh: Freshness) -> DriveStatus:
    """What the amplifier said, with the ages of both feedbacks."""
    return {
        **fresh.feedback(record.amplifier_age),
        "state": DriveState(record.drive_state).name,
        "status_word": f"0x{record.status_word & 0xFFFF:04X}",
        "mode": record.mode,
        "error_code": f"0x{record.drive_error & 0xFFFF:04X}",
        "feedback_age_cycles": record.amplifier_age,
        "encoder_age_cycles": record.encoder_age,
    }


def inputs_status(inputs: InputsConfig, record: CycleRecord) -> list[InputStatus]:
    """The configured inputs, as the loop judged them in this cycle."""
    rows = (
        ("estop", inputs.estop_bit is not None, FaultCode.ESTOP_ACTIVE),
        ("sto", inputs.reports_sto, FaultCode.STO_ACTIVE),
    )
    return [{"name": n, "active": bool(record.faults & FAULTS[code].bit)} for n, there, code in rows if there]


def brake_status(brake: BrakeConfig, record: CycleRecord) -> BrakeStatus:
    """By the state of the axis, for a brake has no sensor."""
    return {"by": brake.by, "state": "none" if brake.by == "none" else _BRAKE[AxisState(record.axis_state)]}


def motion_status(record: CycleRecord, fresh: Freshness, abandoned: str = "") -> MotionStatus:
    """Reference, feedback and the parts of the torque."""
    return {
        **fresh.feedback(record.encoder_age),
        "reference_rad": _finite(record.reference_rad),
        "position_rad": _finite(record.position_rad),
        "following_error_rad": _finite(record.reference_rad - record.position_rad),
        "velocity_rad_s": _finite(record.velocity_rad_s),
        "motor_position_rad": _finite(record.motor_position_rad),
        "torque_nm": _finite(record.torque_nm),
        "torque_actual_nm": _finite(record.torque_actual_nm),
        "torque_feedback_nm": _finite(record.torque_feedback_nm),
        "torque_friction_nm": _finite(record.torque_friction_nm),
        "torque_other_nm": _finite(record.torque_other_nm),
        "friction_state_rad": _finite(record.friction_state),
        "disturbance_nm": _finite(record.disturbance_nm),
        "abandoned": abandoned,
    }


def bus_status(bus: BusConfig, load: float, record: CycleRecord) -> BusStatus:
    """The bus as configured, and its counters."""
    return {
        "interface": bus.interface,
        "channel": bus.channel,
        "load": load,
        "max_load": bus.max_load,
        "queue_full": record.bus_queue_full,
        "error_frames": record.bus_error_frames,
        "late_frames": record.late_frames,
        "ignored_frames": record.ignored_frames,
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def fault_status(record: CycleRecord) -> list[FaultStatus]:
    """The latched faults, in table order."""
    return [_fault_row(f, record.faults) for f in faults_in(record.faults_latched | record.faults)]


def _fault_row(fault: Fault, present: int) -> FaultStatus:
    return {
        "code": fault.code.name,
        "present": bool(present & fault.bit),
        "reaction": fault.reaction.name,
        "cause": fault.cause,
        "remedy": fault.remedy,
    }
