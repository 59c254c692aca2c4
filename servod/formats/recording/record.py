"""The cycle record: what the loop writes once per cycle, and everything that recorder, status and metrics know of it.

Every field is eight bytes (float64 or int64), so the record is at once a struct, a row of a numpy structured array and,
behind four bytes of header, a CDR message of the ROS 2 schema in `ros2msg()`, which PlotJuggler and Foxglove read.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import NamedTuple


@dataclass(frozen=True, slots=True)
class Field:
    """One field of the record; `kind` is "d" (float64) or "q" (int64)."""

    name: str
    kind: str
    unit: str
    text: str


FIELDS: tuple[Field, ...] = (
    Field("time_ns", "q", "ns", "CLOCK_MONOTONIC at the cycle's SYNC (virtual time when stepped)"),
    Field("cycle", "q", "1", "number of the cycle; skipped periods count"),
    Field("missed", "q", "1", "periods skipped since the start"),
    Field("lag_ns", "q", "ns", "wake-up after the deadline"),
    Field("tick_ns", "q", "ns", "work of the previous cycle without waiting"),
    Field("torque_sent_ns", "q", "ns", "deadline to torque frame of the previous cycle"),
    Field("axis_state", "q", "enum", "servod.runtime.loop.axis_state.AxisState"),
    Field("drive_state", "q", "enum", "servod.runtime.fieldbus.devices.DriveState"),
    Field("status_word", "q", "bits", "0x6041"),
    Field("mode", "q", "enum", "0x6061"),
    Field("goal", "q", "enum", "servod.runtime.fieldbus.devices.Goal"),
    Field("goal_reached", "q", "bool", "the drive is where it shall be"),
    Field("reasons", "q", "bits", "servod.runtime.fieldbus.devices.Reason, why not"),
    Field("faults", "q", "bits", "faults present now, servod.common.faults.FaultCode"),
    Field("faults_latched", "q", "bits", "faults since the last enable or reset"),
    Field("drive_error", "q", "code", "0x603F or EMCY code"),
    Field("amplifier_age", "q", "cycles", "age of the amplifier's feedback"),
    Field("encoder_age", "q", "cycles", "age of the encoder's feedback"),
    Field("controller", "q", "1", "serial number of the active gain set in this run"),
    Field("command_seq", "q", "1", "last command that was carried out"),
    Field(
        "command_result",
        "q",
        "code",
        "0 done, below zero to be confirmed, otherwise servod.runtime.loop.commands.Refusal",
    ),
    Field("reference_active", "q", "bool", "a reference motion is running"),
    Field("bus_queue_full", "q", "1", "frames that could not be queued"),
    Field("bus_error_frames", "q", "1", "error frames seen"),
    Field("late_frames", "q", "1", "feedback that came after its cycle, since the start"),
    Field("ignored_frames", "q", "1", "frames that did not fit their mapping, since the start"),
    Field("reference_rad", "d", "rad", "reference position"),
    Field("reference_velocity_rad_s", "d", "rad/s", "reference velocity"),
    Field("position_rad", "d", "rad", "encoder position"),
    Field("velocity_rad_s", "d", "rad/s", "encoder velocity, low-passed"),
    Field("motor_position_rad", "d", "rad", "amplifier's position, joint side"),
    Field("torque_actual_nm", "d", "N*m", "0x6077"),
    Field("torque_nm", "d", "N*m", "commanded torque after limits"),
    Field("torque_controller_nm", "d", "N*m", "controller's torque before limits"),
    Field("torque_feedback_nm", "d", "N*m", "part: state feedback"),
    Field("torque_friction_nm", "d", "N*m", "part: friction compensation"),
    Field("torque_other_nm", "d", "N*m", "part: disturbance observer, feed-forward, bumpless offset"),
    Field("friction_state", "d", "rad", "estimated bristle deflection"),
    Field("disturbance_nm", "d", "N*m", "estimated disturbance"),
)

RECORD = struct.Struct("<" + "".join(f.kind for f in FIELDS))

#: CDR encapsulation header: little endian (OMG CDR, as in ROS 2 serialised messages).
CDR_HEADER = b"\x00\x01\x00\x00"


class CycleRecord(NamedTuple):
    """One cycle, field by field in the order of FIELDS."""

    time_ns: int
    cycle: int
    missed: int
    lag_ns: int
    tick_ns: int
    torque_sent_ns: int
    axis_state: int
    drive_state: int
    status_word: int
    mode: int
    goal: int
    goal_reached: int
    reasons: int
    faults: int
    faults_latched: int
    drive_error: int
    amplifier_age: int
    encoder_age: int
    controller: int
    command_seq: int
    command_result: int
    reference_active: int
    bus_queue_full: int
    bus_error_frames: int
    late_frames: int
    ignored_frames: int
    reference_rad: float
    reference_velocity_rad_s: float
    position_rad: float
    velocity_rad_s: float
    motor_position_rad: float
    torque_actual_nm: float
    torque_nm: float
    torque_controller_nm: float
    torque_feedback_nm: float
    torque_friction_nm: float
    torque_other_nm: float
    friction_state: float
    disturbance_nm: float

    @classmethod
    def unpack(cls, data: bytes | memoryview) -> CycleRecord:
        """The record in `data` (RECORD.size bytes)."""
        return cls._make(RECORD.unpack(data))


def ros2msg() -> str:
    """The record as a ROS 2 message definition, for the schema of a recording."""
    types = {"d": "float64", "q": "int64"}
    return "".join(f"{types[f.kind]} {f.name}  # [{f.unit}] {f.text}\n" for f in FIELDS)
