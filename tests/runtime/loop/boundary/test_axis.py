"""Every fault in every state of the axis, every request in every state, and every time to the exact cycle.

`scripts/mutate.py axis` shows that each of these lines is needed; the stories stand in tests/cycles.
"""

from __future__ import annotations

import pytest

from servod.common.faults import FAULTS, NEEDS_RESTART, FaultCode, Reaction
from servod.runtime.fieldbus.devices import DriveState, Goal, Mode, Reason
from servod.runtime.loop.axis import Axis
from servod.runtime.loop.axis_state import AxisState
from servod.runtime.loop.commands import Refusal
from tests.runtime.loop.boundary.axis_rig import (
    BEFORE_CONTROL,
    BIT,
    CONTROLLED,
    PERIOD_S,
    RAMP,
    READY,
    STATES,
    TIMEOUT,
    D,
    F,
    S,
    axis_in,
    new,
    step,
)


@pytest.mark.parametrize("state", STATES)
def test_each_state_stays_and_asks_for_what_belongs_to_it(state: AxisState) -> None:
    axis = axis_in(state)
    output = step(axis)
    assert axis.state == state
    goals = {S.DISABLED: Goal.OFF, S.FAULT: Goal.OFF, S.QUICK_STOPPING: Goal.QUICK_STOP}
    assert axis.goal == goals.get(state, Goal.ENABLED)
    assert output.controlled is (state in CONTROLLED)
    assert output.torque_share == ((1.0 - 1 / RAMP if state == S.RAMPING else 1.0) if state in CONTROLLED else 0.0)
    assert output.brake is (state == S.BRAKING)
    assert (output.just_enabled, output.reset_fault) == (False, False)
    assert axis.faults == 0
    assert axis.latched == (BIT[F.ENCODER_ALARM] if state == S.FAULT else 0)


def test_new_axis_is_disabled_without_faults() -> None:
    assert (new().state, new().faults, new().latched, new().unheard) == (S.DISABLED, 0, 0, False)


def test_recorded_numbers_of_the_states_stay() -> None:
    names = ["DISABLED", "ENABLING", "ENABLED", "BRAKING", "RAMPING", "QUICK_STOPPING", "FAULT", "PROVING"]
    names += ["RELEASING", "ENGAGING"]
    assert [(state.name, int(state)) for state in S] == [(name, number) for number, name in enumerate(names)]


# --- faults -----------------------------------------------------------------------------------------------------------
def expected(state: AxisState, code: FaultCode) -> AxisState:
    """Where the fault leads, said again from the documentation of the reactions."""
    reaction = FAULTS[code].reaction
    if state in (S.DISABLED, S.FAULT):
        return S.FAULT if code in (F.DRIVE_STAYS_POWERED, F.COMMANDS_LOST) else state
    if reaction <= Reaction.CLIP:
        return state
    if reaction == Reaction.DISABLE or state in BEFORE_CONTROL:
        return S.FAULT
    if reaction == Reaction.QUICK_STOP or state == S.QUICK_STOPPING:
        return S.QUICK_STOPPING
    if state == S.ENABLED:
        return S.BRAKING if code == F.SUPERVISOR_LOST else S.RAMPING
    if state == S.BRAKING:  # its law is not sound any more
        return S.BRAKING if code == F.SUPERVISOR_LOST else S.RAMPING
    return state


@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("code", list(F))
def test_every_fault_in_every_state_has_its_reaction(code: FaultCode, state: AxisState) -> None:
    axis = axis_in(state)
    before = axis.latched
    step(axis, BIT[code])
    assert axis.state == expected(state, code)
    assert axis.faults == BIT[code]
    kept = state not in (S.DISABLED, S.FAULT) or code in NEEDS_RESTART | {F.SECOND_MASTER, F.FOREIGN_FEEDBACK}
    assert axis.latched == before | (BIT[code] if kept else 0)
    assert axis.unheard is (code in (F.DRIVE_STAYS_POWERED, F.COMMANDS_LOST) and bool(axis.latched & BIT[code]))


@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("code", [F.TORQUE_CLIPPED, F.FOLLOWING_ERROR, F.SPEED_LIMIT, F.NOT_FINITE])
def test_fault_after_the_step_reacts_in_the_same_cycle(code: FaultCode, state: AxisState) -> None:
    axis = axis_in(state)
    step(axis)
    axis.raise_fault(BIT[code])
    assert axis.state == expected(state, code)
    assert axis.faults == BIT[code]
    axis.raise_fault(BIT[F.DRIVE_WARNING])
    assert axis.faults == BIT[code] | BIT[F.DRIVE_WARNING], "the one before is not forgotten"


def test_strongest_of_several_faults_wins() -> None:
    for weak, strong in ((F.FOLLOWING_ERROR, F.SPEED_LIMIT), (F.SPEED_LIMIT, F.NOT_FINITE)):
        axis = axis_in(S.ENABLED)
        step(axis, BIT[weak] | BIT[strong] | BIT[F.TORQUE_CLIPPED])
        assert axis.state == expected(S.ENABLED, strong)
    axis = axis_in(S.ENABLED)
    step(axis, BIT[F.SUPERVISOR_LOST] | BIT[F.FOLLOWING_ERROR])
    assert axis.state == S.RAMPING, "braking wants a sound controller"
    axis = axis_in(S.ENABLED)
    step(axis, BIT[F.SUPERVISOR_LOST] | BIT[F.TORQUE_CLIPPED])
    assert axis.state == S.BRAKING


@pytest.mark.parametrize("state", [S.BRAKING, S.RAMPING, S.QUICK_STOPPING])
@pytest.mark.parametrize("code", [F.FOLLOWING_ERROR, F.SPEED_LIMIT])
def test_stop_on_request_that_fails_ends_in_fault(state: AxisState, code: FaultCode) -> None:
    axis = axis_in(state)
    step(axis, BIT[code])
    for _ in range(4 * TIMEOUT):
        step(axis, at_rest=True)
    assert axis.state == S.FAULT


@pytest.mark.parametrize("state", [S.BRAKING, S.RAMPING, S.QUICK_STOPPING])
@pytest.mark.parametrize("code", [None, F.TORQUE_CLIPPED, F.DEADLINE_LATE])
def test_stop_on_request_ends_disabled(state: AxisState, code: FaultCode | None) -> None:
    axis = axis_in(state)
    step(axis, 0 if code is None else BIT[code])
    for _ in range(4 * TIMEOUT):
        step(axis, at_rest=True)
    assert axis.state == S.DISABLED


@pytest.mark.parametrize("way", [F.SUPERVISOR_LOST, F.FOLLOWING_ERROR, F.SPEED_LIMIT])
def test_quick_stop_of_a_motion_that_failed_still_ends_in_fault(way: FaultCode) -> None:
    axis = axis_in(S.ENABLED)
    step(axis, BIT[way])
    axis.quick_stop()
    for _ in range(2 * TIMEOUT):
        step(axis)
    assert axis.state == S.FAULT


def test_fault_that_lasts_gives_the_quick_stop_no_more_time() -> None:
    axis = axis_in(S.QUICK_STOPPING)
    states = [(step(axis, BIT[F.SPEED_LIMIT]), axis.state)[1] for _ in range(TIMEOUT + 1)]
    assert states == [S.QUICK_STOPPING] * TIMEOUT + [S.FAULT]


@pytest.mark.parametrize("state", CONTROLLED)
@pytest.mark.parametrize("failed_before", [False, True])
def test_quick_stop_of_a_sound_motion_ends_disabled(failed_before: bool, state: AxisState) -> None:
    axis = new()
    if failed_before:
        axis = axis_in(S.ENABLED)
        step(axis, BIT[F.FOLLOWING_ERROR])
        for _ in range(2 * RAMP):
            step(axis)
        assert axis.state == S.FAULT
    assert axis.enable(reset_fault=failed_before) == Refusal.DONE
    step(axis, **READY)
    if state != S.ENABLED:
        axis.disable()
        step(axis, at_rest=state == S.RAMPING)
    assert axis.state == state
    axis.quick_stop()
    for _ in range(2 * TIMEOUT):
        step(axis)
    assert axis.state == S.DISABLED


# --- requests ---------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("reset", [False, True])
@pytest.mark.parametrize(
    ("state", "answer"),
    [
        (S.ENABLING, Refusal.DONE),
        (S.PROVING, Refusal.DONE),
        (S.ENABLED, Refusal.DONE),
        (S.BRAKING, Refusal.MOTION_RUNNING),
        (S.RAMPING, Refusal.MOTION_RUNNING),
        (S.QUICK_STOPPING, Refusal.MOTION_RUNNING),
    ],
)
def test_enable_beside_another_state_changes_nothing(state: AxisState, answer: Refusal, reset: bool) -> None:
    axis = axis_in(state)
    assert axis.enable(reset) == answer
    assert axis.state == state
    assert step(axis).reset_fault is False


@pytest.mark.parametrize("code", list(F))
@pytest.mark.parametrize("reset", [False, True])
def test_enable_with_a_latched_fault(code: FaultCode, reset: bool) -> None:
    axis = new()
    axis.note(BIT[code])
    answer = axis.enable(reset)
    if code in NEEDS_RESTART:
        assert (answer, axis.state) == (Refusal.NEEDS_RESTART, S.DISABLED)
    elif not reset and FAULTS[code].reaction > Reaction.CLIP:
        assert (answer, axis.state, axis.latched) == (Refusal.FAULT_PRESENT, S.DISABLED, BIT[code])
    else:
        assert (answer, axis.state, axis.latched) == (Refusal.DONE, S.ENABLING, 0)
        assert step(axis).reset_fault is reset
        assert step(axis).reset_fault is False, "one edge"


@pytest.mark.parametrize("state", STATES)
def test_reset_in_every_state(state: AxisState) -> None:
    axis = axis_in(state)
    axis.note(BIT[F.DRIVE_RESET] | BIT[F.SPEED_LIMIT])
    if state in (*CONTROLLED, S.PROVING):
        assert (axis.reset_fault(), axis.state) == (Refusal.MOTION_RUNNING, state)
        assert axis.latched == BIT[F.DRIVE_RESET] | BIT[F.SPEED_LIMIT]
        assert step(axis).reset_fault is False
        return
    assert axis.reset_fault() == Refusal.DONE
    assert axis.latched == BIT[F.DRIVE_RESET], "what needs a restart is not forgotten"
    assert axis.state == (S.DISABLED if state == S.FAULT else state)
    assert [step(axis).reset_fault, step(axis).reset_fault] == [True, False]


@pytest.mark.parametrize("state", STATES)
def test_disable_and_quick_stop_in_every_state(state: AxisState) -> None:
    disabled, stopped = axis_in(state), axis_in(state)
    disabled.disable()
    assert disabled.state == {S.ENABLED: S.BRAKING, S.ENABLING: S.DISABLED, S.PROVING: S.DISABLED}.get(state, state)
    stopped.quick_stop()
    after = S.QUICK_STOPPING if state in CONTROLLED else S.DISABLED if state in BEFORE_CONTROL else state
    assert stopped.state == after


def test_what_the_supervisor_saw_is_latched_and_does_not_act_by_itself() -> None:
    axis = axis_in(S.ENABLED)
    axis.note(BIT[F.SPEED_LIMIT])
    axis.note(BIT[F.DRIVE_WARNING])
    step(axis)
    assert (axis.state, axis.faults) == (S.ENABLED, 0)
    assert axis.latched == BIT[F.SPEED_LIMIT] | BIT[F.DRIVE_WARNING]


# --- times, to the cycle ----------------------------------------------------------------------------------------------
def test_ramp_goes_down_in_equal_steps_and_ends() -> None:
    axis = axis_in(S.RAMPING)
    shares = [step(axis).torque_share for _ in range(RAMP)]
    assert shares == [1.0 - k / RAMP for k in range(1, RAMP)] + [0.0]
    assert axis.state == S.DISABLED


def test_braking_ends_at_rest_or_after_its_time() -> None:
    axis = axis_in(S.BRAKING)
    assert step(axis, at_rest=True).torque_share == 1.0, "the ramp begins where the torque is"
    assert axis.state == S.RAMPING
    axis = axis_in(S.BRAKING)
    states = [(step(axis), axis.state)[1] for _ in range(RAMP + 1)]
    assert states == [S.BRAKING] * RAMP + [S.RAMPING]


@pytest.mark.parametrize(("reasons", "code"), [(0, F.ENABLE_TIMEOUT), (Reason.IN_FAULT, F.DRIVE_FAULT)])
def test_drive_that_does_not_enable_has_its_time(reasons: int, code: FaultCode) -> None:
    axis = axis_in(S.ENABLING)
    for _ in range(TIMEOUT):
        step(axis, reasons=reasons | Reason.NO_VOLTAGE)
        assert (axis.state, axis.faults) == (S.ENABLING, 0)
    step(axis, BIT[F.DEADLINE_LATE], reasons=reasons | Reason.NO_VOLTAGE)
    assert axis.state == S.FAULT
    assert axis.faults == axis.latched == BIT[code] | BIT[F.DEADLINE_LATE]


@pytest.mark.parametrize("drive", [D.SWITCH_ON_DISABLED, D.READY_TO_SWITCH_ON, D.FAULT])
def test_quick_stop_is_over_when_the_drive_says_so_now(drive: DriveState) -> None:
    axis = axis_in(S.QUICK_STOPPING)
    step(axis, state=drive, age_cycles=1)
    assert axis.state == S.QUICK_STOPPING, "an old word says nothing"
    step(axis, state=drive)
    assert axis.state == (S.FAULT if drive == D.FAULT else S.DISABLED)


@pytest.mark.parametrize("drive", [D.QUICK_STOP_ACTIVE, D.SWITCHED_ON, D.NOT_READY_TO_SWITCH_ON, D.UNKNOWN])
def test_quick_stop_has_its_time(drive: DriveState) -> None:
    axis = axis_in(S.QUICK_STOPPING)
    for _ in range(TIMEOUT):
        step(axis, state=drive)
        assert axis.state == S.QUICK_STOPPING
    step(axis, state=drive)
    assert axis.state == S.DISABLED


def test_times_shorter_than_a_cycle_are_one_cycle() -> None:
    axis = Axis(PERIOD_S, 1e-9, 1e-9, Mode.CYCLIC_SYNC_TORQUE, 1.0)
    axis.enable(False)
    step(axis)
    assert axis.state == S.ENABLING
    step(axis)
    assert axis.state == S.FAULT
    axis = Axis(PERIOD_S, 1e-9, TIMEOUT * PERIOD_S, Mode.CYCLIC_SYNC_TORQUE, 1.0)
    axis.enable(False)
    step(axis, **READY)
    axis.disable()
    step(axis, at_rest=True)
    assert axis.state == S.RAMPING
    assert (step(axis).torque_share, axis.state) == (0.0, S.DISABLED)
