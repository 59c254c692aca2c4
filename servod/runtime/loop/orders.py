"""The supervisor's commands, carried out by the loop between two cycles. One small function for each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from servod.common.faults import FAULTS, FaultCode
from servod.common.units import NS_PER_S
from servod.runtime.loop.axis import AxisState
from servod.runtime.loop.commands import Command, Op, Refusal
from servod.runtime.loop.references import make_motion

if TYPE_CHECKING:
    from servod.runtime.loop.cycle import Cycle

#: Faults that make what was proven doubtful: a sensor or a scale may not be what it was.
_DOUBTFUL = sum(
    FAULTS[code].bit
    for code in (
        FaultCode.SPEED_LIMIT,
        FaultCode.FOLLOWING_ERROR,
        FaultCode.ENCODER_IMPLAUSIBLE,
        FaultCode.ENCODER_ALARM,
        FaultCode.NOT_FINITE,
        FaultCode.WIRING_NOT_PROVEN,
    )
)

Order = Callable[["Cycle", Sequence[float]], Refusal]


def carry_out(cycle: Cycle, command: Command) -> Refusal:
    """Carry out one command; the answer goes into the cycle record."""
    order = _ORDERS.get(command.op)
    return Refusal.BAD_ARGUMENT if order is None else order(cycle, command.arguments)


def _enable(cycle: Cycle, arguments: Sequence[float]) -> Refusal:
    position_rad = cycle.encoder_position_rad
    if not cycle.limits.position_min_rad <= position_rad <= cycle.limits.position_max_rad:
        return Refusal.OUTSIDE_LIMITS
    reset_fault, asked = ([bool(value) for value in arguments] + [False, False])[:2]
    if not cycle.axis.state.stopped:
        return Refusal.PROVES_ONLY_FROM_OFF if asked else cycle.axis.enable(reset_fault)
    doubtful = not cycle.proof.proven or bool(cycle.axis.latched & _DOUBTFUL)
    prove = asked or (cycle.proof_wanted and doubtful)
    refusal = cycle.axis.enable(reset_fault, prove)
    if refusal == Refusal.DONE and prove:
        cycle.proof.forget()
    return refusal


def _disable(cycle: Cycle, _arguments: Sequence[float]) -> Refusal:
    cycle.axis.disable()
    return Refusal.DONE


def _quick_stop(cycle: Cycle, _arguments: Sequence[float]) -> Refusal:
    cycle.axis.quick_stop()
    return Refusal.DONE


def _halt(cycle: Cycle, arguments: Sequence[float]) -> Refusal:
    cycle.reference.halt(bool(arguments and arguments[0]))
    return Refusal.DONE


def _activate(cycle: Cycle, arguments: Sequence[float]) -> Refusal:
    serial, law, count, *parameters = arguments
    if len(parameters) != int(count):
        return Refusal.BAD_ARGUMENT
    if not cycle.controller.activate(int(law), parameters, cycle.torque_nm):
        return Refusal.BAD_ARGUMENT
    cycle.controller_serial = int(serial)
    return Refusal.DONE


def _reference(cycle: Cycle, arguments: Sequence[float]) -> Refusal:
    if cycle.axis.state != AxisState.ENABLED:
        return Refusal.NOT_ENABLED
    if cycle.reference.active:
        return Refusal.MOTION_RUNNING
    period_s = cycle.period_ns / NS_PER_S
    motion = make_motion(arguments, period_s, cycle.link.trajectory)
    if isinstance(motion, Refusal):
        return motion
    here, limits = cycle.reference.position_rad, cycle.limits
    if here + motion.lowest_rad < limits.position_min_rad or here + motion.highest_rad > limits.position_max_rad:
        return Refusal.OUT_OF_RANGE
    if motion.speed_rad_s > limits.speed_rad_s:
        return Refusal.TOO_FAST
    if not abs(here + motion.first_rad(period_s) - cycle.encoder_position_rad) <= limits.following_error_rad:
        return Refusal.JUMPS
    cycle.reference.start(motion)
    return Refusal.DONE


def _shutdown(cycle: Cycle, _arguments: Sequence[float]) -> Refusal:
    cycle.shut_down()
    return Refusal.DONE


def _node_event(cycle: Cycle, arguments: Sequence[float]) -> Refusal:
    bit = FAULTS[FaultCode(int(arguments[0]))].bit
    cycle.event_faults |= bit
    cycle.axis.note(bit)
    return Refusal.DONE


_ORDERS: dict[int, Order] = {
    Op.ENABLE: _enable,
    Op.DISABLE: _disable,
    Op.QUICK_STOP: _quick_stop,
    Op.HALT: _halt,
    Op.ACTIVATE: _activate,
    Op.REFERENCE: _reference,
    Op.SHUTDOWN: _shutdown,
    Op.NODE_EVENT: _node_event,
}
