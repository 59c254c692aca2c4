"""An axis brought to each of its states, and the drive that goes with it."""

from __future__ import annotations

from typing import Any

from servod.common.faults import FAULTS, FaultCode
from servod.runtime.fieldbus.devices import DriveState, Mode
from servod.runtime.loop.axis import Axis
from servod.runtime.loop.axis_state import AxisState
from servod.runtime.loop.commands import Refusal
from tests.runtime.loop.boundary.feedback import amplifier

S, D, F = AxisState, DriveState, FaultCode
PERIOD_S = 2.0**-10
RAMP, TIMEOUT, OBEY, PROOF = 8, 16, 31, 64  # cycles; 0.03 s are 30.7
PROOF_MARGIN = 256  # cycles
STALE = 5  # cycles
BIT = {code: fault.bit for code, fault in FAULTS.items()}
#: Those of an axis without a brake; with one: tests/runtime/loop/test_brake.py.
STATES = [state for state in S if state not in (S.RELEASING, S.ENGAGING)]
CONTROLLED = (S.ENABLED, S.BRAKING, S.RAMPING)
BEFORE_CONTROL = (S.ENABLING, S.PROVING)
OFF = {"state": D.SWITCH_ON_DISABLED, "status_word": 0x0240, "goal_reached": False}
WAITING = {"goal_reached": False}
READY = {"state": D.OPERATION_ENABLED, "status_word": 0x0237, "goal_reached": True}
#: What the drive shows while the axis stays in each state.
DRIVE: dict[AxisState, dict[str, Any]] = {
    S.DISABLED: OFF,
    S.ENABLING: OFF,
    S.PROVING: WAITING,
    S.ENABLED: {},
    S.BRAKING: {},
    S.RAMPING: {},
    S.QUICK_STOPPING: {"state": D.QUICK_STOP_ACTIVE, "goal_reached": False},
    S.FAULT: OFF,
}


def step(axis: Axis, faults: int = 0, fresh: bool = True, at_rest: bool = False, **drive: Any) -> Any:
    """One cycle with a drive that stays where it is unless `drive` says otherwise."""
    return axis.step(amplifier(**{**DRIVE[axis.state], **drive}), fresh, faults, at_rest)


def new() -> Axis:
    return Axis(
        PERIOD_S, RAMP * PERIOD_S, TIMEOUT * PERIOD_S, Mode.CYCLIC_SYNC_TORQUE, PROOF * PERIOD_S, stale_cycles=STALE
    )


def axis_in(state: AxisState) -> Axis:
    """An axis that came to `state` on the usual way."""
    axis = new()
    if state == S.DISABLED:
        return axis
    assert axis.enable(False, prove=state == S.PROVING) == Refusal.DONE
    if state == S.ENABLING:
        return axis
    step(axis, state=D.OPERATION_ENABLED, status_word=0x0237, goal_reached=True)
    if state in (S.BRAKING, S.RAMPING):
        axis.disable()
    if state == S.RAMPING:
        step(axis, at_rest=True)
    if state == S.QUICK_STOPPING:
        axis.quick_stop()
    if state == S.FAULT:
        step(axis, BIT[F.ENCODER_ALARM])
    assert axis.state == state
    return axis
