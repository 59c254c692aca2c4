"""The supervisor's commands, carried out by the loop between two cycles. One small method for each."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from zlib import crc32

from servod.common.faults import FAULTS, FaultCode
from servod.common.units import NS_PER_S
from servod.kernels.motions import Samples
from servod.runtime.loop.axis import Axis
from servod.runtime.loop.axis_state import AxisState
from servod.runtime.loop.commands import Command, Op, Refusal
from servod.runtime.loop.controller import Controller
from servod.runtime.loop.limits import Limits
from servod.runtime.loop.references import Reference, make_motion
from servod.runtime.loop.wiring.wiring_test import WiringTest

#: Faults that make what was proven doubtful: a sensor or a scale may not be what it was.
_DOUBTFUL = sum(
    FAULTS[code].bit
    for code in (
        FaultCode.SPEED_LIMIT,
        FaultCode.FOLLOWING_ERROR,
        FaultCode.ENCODER_IMPLAUSIBLE,
        FaultCode.ENCODER_ALARM,
        FaultCode.TORQUE_IMPLAUSIBLE,
        FaultCode.OSCILLATES,
        FaultCode.NOT_FINITE,
        FaultCode.WIRING_NOT_PROVEN,
    )
)
#: A request to enable is to be confirmed within this time.
_CONFIRM_NS = NS_PER_S


class Orders:
    """The parts of the loop that a command may touch, and what it leaves for the cycle to read.

    `controller_serial` is the number of the gain set that runs; `event_faults` are what the supervisor raised for one
    cycle, which takes them.
    """

    def __init__(
        self,
        axis: Axis,
        reference: Reference,
        controller: Controller,
        limits: Limits,
        proof: WiringTest,
        proof_wanted: bool,
        trajectory: Samples,
        period_s: float,
        controller_serial: int,
        shut_down: Callable[[], None],
    ) -> None:
        """`trajectory` is the area that table motions read, `shut_down` begins the end of the loop."""
        self._axis, self._reference, self._controller, self._limits = axis, reference, controller, limits
        self._proof, self._proof_wanted = proof, proof_wanted
        self._trajectory, self._period_s, self._shut_down = trajectory, period_s, shut_down
        self.controller_serial = controller_serial
        self.event_faults = 0
        self._position_rad = self._torque_nm = 0.0
        self._request: Command | None = None  # an ENABLE that is to be confirmed
        self._challenge = 0
        self._table: dict[int, Callable[[Sequence[float]], Refusal]] = {
            Op.ENABLE: self._enable,
            Op.DISABLE: self._disable,
            Op.QUICK_STOP: self._quick_stop,
            Op.HALT: self._halt,
            Op.ACTIVATE: self._activate,
            Op.REFERENCE: self._start_motion,
            Op.SHUTDOWN: self._end,
            Op.NODE_EVENT: self._raise_event,
            Op.CORRUPT: self._corrupt,
        }

    def carry_out(self, command: Command, position_rad: float, torque_nm: float) -> int:
        """Carry out one command, with joint and torque as they are now; the answer goes into the cycle record.

        A Refusal, or below zero what an ENABLE is to be confirmed with, by the very next command.
        """
        self._position_rad, self._torque_nm = position_rad, torque_nm
        request, self._request = self._request, None
        if command.op == Op.ENABLE and self._axis.state.stopped:
            self._request = command
            said_and_seen = struct.pack("<qqdd", command.seq, command.sent_ns, position_rad, torque_nm)
            self._challenge = -1 - crc32(said_and_seen)
            return self._challenge
        if command.op == Op.CONFIRM:
            return self._confirm(request, command)
        order = self._table.get(command.op)
        return Refusal.BAD_ARGUMENT if order is None else order(command.arguments)

    def _confirm(self, request: Command | None, command: Command) -> Refusal:
        """The second of the two messages that it takes to enable; it repeats what the loop answered to the first."""
        if request is None or command.arguments != (float(self._challenge),):
            return Refusal.NOT_CONFIRMED
        if command.sent_ns - request.sent_ns > _CONFIRM_NS:
            return Refusal.NOT_CONFIRMED
        return self._enable(request.arguments)

    def _enable(self, arguments: Sequence[float]) -> Refusal:
        if not self._limits.position_min_rad <= self._position_rad <= self._limits.position_max_rad:
            return Refusal.OUTSIDE_LIMITS
        reset_fault, asked = ([bool(value) for value in arguments] + [False, False])[:2]
        if not self._axis.state.stopped:
            return Refusal.PROVES_ONLY_FROM_OFF if asked else self._axis.enable(reset_fault)
        doubtful = not self._proof.proven or bool(self._axis.latched & _DOUBTFUL)
        prove = asked or (self._proof_wanted and doubtful)
        refusal = self._axis.enable(reset_fault, prove)
        if refusal == Refusal.DONE and prove:
            self._proof.forget()
        return refusal

    def _disable(self, _arguments: Sequence[float]) -> Refusal:
        self._axis.disable()
        return Refusal.DONE

    def _quick_stop(self, _arguments: Sequence[float]) -> Refusal:
        self._axis.quick_stop()
        return Refusal.DONE

    def _halt(self, arguments: Sequence[float]) -> Refusal:
        on, leave = ([bool(value) for value in arguments] + [False, False])[:2]
        self._reference.halt(on, leave)
        return Refusal.DONE

    def _activate(self, arguments: Sequence[float]) -> Refusal:
        serial, law, count, *parameters = arguments
        if len(parameters) != int(count):
            return Refusal.BAD_ARGUMENT
        if not self._controller.activate(int(law), parameters, self._torque_nm):
            return Refusal.BAD_ARGUMENT
        self.controller_serial = int(serial)
        return Refusal.DONE

    def _start_motion(self, arguments: Sequence[float]) -> Refusal:
        if self._axis.state != AxisState.ENABLED:
            return Refusal.NOT_ENABLED
        if self._reference.active:
            return Refusal.MOTION_RUNNING
        motion = make_motion(arguments, self._period_s, self._trajectory)
        if isinstance(motion, Refusal):
            return motion
        here, limits = self._reference.position_rad, self._limits
        if here + motion.lowest_rad < limits.position_min_rad or here + motion.highest_rad > limits.position_max_rad:
            return Refusal.OUT_OF_RANGE
        if motion.speed_rad_s > limits.speed_rad_s:
            return Refusal.TOO_FAST
        if not abs(here + motion.first_rad(self._period_s) - self._position_rad) <= limits.following_error_rad:
            return Refusal.JUMPS
        self._reference.start(motion)
        return Refusal.DONE

    def _end(self, _arguments: Sequence[float]) -> Refusal:
        self._shut_down()
        return Refusal.DONE

    def _raise_event(self, arguments: Sequence[float]) -> Refusal:
        bit = FAULTS[FaultCode(int(arguments[0]))].bit
        self.event_faults |= bit
        self._axis.note(bit)
        return Refusal.DONE

    def _corrupt(self, _arguments: Sequence[float]) -> Refusal:
        self._raise_event((FaultCode.CHANNEL_CORRUPT,))
        return Refusal.CORRUPT
