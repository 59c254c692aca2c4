"""What the drive says and how long it may take to obey, cycle by cycle; beside test_axis."""

from __future__ import annotations

from typing import Any

import pytest

from servod.common.faults import FaultCode
from servod.runtime.fieldbus.devices import HANDSHAKE_SYNCS, DriveState, Goal, Mode, Reason
from servod.runtime.loop.axis import Axis
from servod.runtime.loop.axis_state import AxisState
from servod.runtime.loop.brake import BrakeTimes
from servod.runtime.loop.commands import Refusal
from tests.runtime.loop.boundary.axis_rig import (
    BIT,
    CONTROLLED,
    DRIVE,
    OBEY,
    OFF,
    PERIOD_S,
    PROOF,
    PROOF_MARGIN,
    RAMP,
    READY,
    STALE,
    STATES,
    TIMEOUT,
    D,
    F,
    S,
    axis_in,
    new,
    step,
)
from tests.runtime.loop.boundary.feedback import amplifier


# --- from the drive's word to the first torque ------------------------------------------------------------------------
@pytest.mark.parametrize(
    "missing",
    [{"fresh": False}, {"age_cycles": 1}, {"goal_reached": False}, {"state": D.SWITCHED_ON}, {"state": D.FAULT}],
)
def test_nothing_is_controlled_until_all_of_it_is_true(missing: dict[str, Any]) -> None:
    axis = axis_in(S.ENABLING)
    output = step(axis, **{**READY, **missing})
    assert (axis.state, output.just_enabled, output.controlled) == (S.ENABLING, False, False)
    output = step(axis, **READY)
    assert (axis.state, output.just_enabled, output.controlled) == (S.ENABLED, True, True)
    assert step(axis).just_enabled is False


def test_proof_stands_between_power_and_control() -> None:
    axis = axis_in(S.PROVING)
    for _ in range(3 * TIMEOUT):
        assert step(axis).controlled is False
    axis.proven()
    output = step(axis)
    assert (axis.state, output.just_enabled, output.torque_share) == (S.ENABLED, True, 1.0)


def test_proof_that_does_not_end_is_ended() -> None:
    axis = axis_in(S.PROVING)
    for _ in range(PROOF + PROOF_MARGIN):
        step(axis)
    assert (axis.state, axis.faults) == (S.PROVING, 0)
    output = step(axis)
    assert (axis.state, output.controlled, output.just_enabled) == (S.FAULT, False, False)
    assert axis.latched == axis.faults == BIT[F.WIRING_NOT_PROVEN]
    axis.proven()
    step(axis)
    assert axis.state == S.FAULT


def test_proof_of_the_last_time_does_not_count() -> None:
    axis = axis_in(S.PROVING)
    axis.proven()
    axis.disable()
    axis.enable(False, prove=True)
    step(axis, **READY)
    step(axis, **READY)
    assert axis.state == S.PROVING


# --- what the drive says ----------------------------------------------------------------------------------------------
@pytest.mark.parametrize("state", STATES)
def test_drive_in_fault_is_one_but_while_it_is_being_reset(state: AxisState) -> None:
    for drive in (D.FAULT, D.FAULT_REACTION_ACTIVE):
        axis = axis_in(state)
        step(axis, state=drive)
        assert bool(axis.faults & BIT[F.DRIVE_FAULT]) is (state != S.ENABLING)
        axis = axis_in(state)
        step(axis, state=drive, age_cycles=1)
        assert not axis.faults & BIT[F.DRIVE_FAULT]


@pytest.mark.parametrize(("bit", "code"), [(7, F.DRIVE_WARNING), (11, F.DRIVE_LIMITS_TORQUE)])
@pytest.mark.parametrize("state", STATES)
def test_bits_of_the_status_word(state: AxisState, bit: int, code: FaultCode) -> None:
    axis = axis_in(state)
    step(axis, status_word=0x0237 | 1 << bit)
    seen = bit == 7 or state in (*CONTROLLED, S.PROVING)
    assert axis.faults == BIT[code] * seen
    axis = axis_in(state)
    step(axis, status_word=0x0237 | 1 << bit, age_cycles=1)
    assert axis.faults == 0


def test_fault_that_two_have_seen_is_one() -> None:
    axis = axis_in(S.ENABLED)
    step(axis, BIT[F.DRIVE_WARNING], status_word=0x0237 | 1 << 7)
    assert (axis.faults, axis.latched) == (BIT[F.DRIVE_WARNING], BIT[F.DRIVE_WARNING])


@pytest.mark.parametrize("state", [*CONTROLLED, S.PROVING])
@pytest.mark.parametrize("drive", list(D))
def test_drive_that_leaves_operation(state: AxisState, drive: DriveState) -> None:
    axis = axis_in(state)
    step(axis, state=drive)
    faults = {D.UNKNOWN: F.DRIVE_STATUS_UNKNOWN, D.FAULT: F.DRIVE_FAULT, D.FAULT_REACTION_ACTIVE: F.DRIVE_FAULT}
    expected_word = 0 if drive == D.OPERATION_ENABLED else BIT[faults.get(drive, F.DRIVE_LEFT_OPERATION)]
    assert axis.faults == expected_word


@pytest.mark.parametrize("mode", [-1, 10, 0, 8, 9, 11])
def test_mode_that_is_shown(mode: int) -> None:
    axis = axis_in(S.ENABLED)
    step(axis, mode=mode)
    assert axis.faults == (0 if mode in (-1, 10) else BIT[F.DRIVE_MODE_WRONG])


def test_remote_bit_says_something_only_once_it_was_seen() -> None:
    never = axis_in(S.ENABLING)
    step(never, **{**READY, "status_word": 0x0037})
    step(never, status_word=0x0037)
    assert never.faults == 0
    axis = axis_in(S.ENABLED)
    step(axis)
    step(axis, status_word=0x0037)
    assert axis.faults == BIT[F.COMMANDS_LOST]


def test_remote_bit_of_the_last_enable_is_forgotten() -> None:
    axis = axis_in(S.ENABLED)
    step(axis)
    axis.quick_stop()
    step(axis, **OFF)
    axis.enable(False)
    step(axis, **{**READY, "status_word": 0x0037})
    step(axis, status_word=0x0037)
    assert axis.faults == 0


@pytest.mark.parametrize("drive", list(D))
def test_commands_that_do_not_arrive_matter_to_a_powered_drive(drive: DriveState) -> None:
    axis = axis_in(S.DISABLED)
    step(axis, state=drive, reasons=Reason.COMMANDS_MISSED | Reason.NO_VOLTAGE)
    powered = drive in (D.OPERATION_ENABLED, D.QUICK_STOP_ACTIVE)
    assert bool(axis.faults & BIT[F.COMMANDS_LOST]) is powered
    axis = axis_in(S.DISABLED)
    step(axis, state=drive, reasons=sum(Reason) - Reason.COMMANDS_MISSED)
    assert not axis.faults & BIT[F.COMMANDS_LOST], "no other reason says so"


FOLLOWS, LIMITED = 0x1237, 0x0A37


def test_a_drive_that_follows_its_command_no_more_does_not_get_it() -> None:
    """Status word bit 12; one that never shows it, or limits its torque, is believed."""
    axis = axis_in(S.ENABLED)
    for word in [0x0237] * 40 + [FOLLOWS] + [0x0237] * 10 + [FOLLOWS] + [0x0237] * 10 + [LIMITED] * 40:
        step(axis, status_word=word)
        assert not axis.faults & BIT[F.COMMANDS_LOST]
    for _ in range(10):
        step(axis, status_word=0x0237)
        assert not axis.faults & BIT[F.COMMANDS_LOST]
    step(axis, status_word=0x0237)
    assert axis.faults & BIT[F.COMMANDS_LOST]
    assert axis.unheard


# --- a drive that does not obey ---------------------------------------------------------------------------------------
STAYS = BIT[F.DRIVE_STAYS_POWERED]


def cycles_until_disobedience(axis: Axis, **drive: Any) -> int:
    """Cycles until the fault, at most 300."""
    for cycle in range(1, 300):
        step(axis, **drive)
        if axis.faults & STAYS:
            return cycle
    return 0


@pytest.mark.parametrize("drive", list(D))
def test_drive_that_stays_powered_when_it_shall_be_off(drive: DriveState) -> None:
    powered = drive in (D.OPERATION_ENABLED, D.QUICK_STOP_ACTIVE)
    axis = axis_in(S.DISABLED)
    assert cycles_until_disobedience(axis, state=drive) == (OBEY + 1 if powered else 0)
    assert axis.state == (S.FAULT if powered else S.DISABLED if drive not in (D.FAULT,) else axis.state)


def test_drive_that_was_not_heard_since_it_was_told_off() -> None:
    axis = axis_in(S.ENABLED)
    step(axis, BIT[F.NOT_FINITE])
    assert cycles_until_disobedience(axis, state=D.SWITCH_ON_DISABLED, age_cycles=1) == OBEY + 1
    axis = axis_in(S.ENABLED)
    step(axis, BIT[F.NOT_FINITE])
    assert cycles_until_disobedience(axis, age_cycles=STALE - 1) == OBEY + 1
    axis = axis_in(S.ENABLED)
    step(axis, BIT[F.NOT_FINITE])
    step(axis, state=D.SWITCH_ON_DISABLED)
    assert cycles_until_disobedience(axis, state=D.SWITCH_ON_DISABLED, age_cycles=1) == 0, "it was seen off"
    assert cycles_until_disobedience(new(), age_cycles=1) == 0, "and so is a drive before its first enable"


@pytest.mark.parametrize("age_cycles", [STALE, STALE + 1, 1000])
def test_a_drive_that_does_not_answer_has_the_handshake_alone(age_cycles: int) -> None:
    """Without SYNC it takes no command, and the deadline of its commands sees them come all the same."""
    axis = axis_in(S.ENABLED)
    step(axis, BIT[F.FEEDBACK_STALE], age_cycles=age_cycles)
    assert axis.state == S.QUICK_STOPPING
    assert cycles_until_disobedience(axis, age_cycles=age_cycles) == HANDSHAKE_SYNCS + 1


@pytest.mark.parametrize("clocked", [True, False])
def test_a_brake_by_output_closes_before_nmt_ends_its_frames_where_sync_lives(clocked: bool) -> None:
    """The encoder tells: it is not heard either when SYNC is lost, and then the drive takes no command."""
    engage = 100
    brake = BrakeTimes(True, PERIOD_S, engage * PERIOD_S)
    axis = Axis(PERIOD_S, 0.01, 10.0, Mode.CYCLIC_SYNC_TORQUE, 1.0, brake=brake, stale_cycles=STALE)
    axis.enable(False)
    for _ in range(10):
        axis.step(amplifier(**READY), True, 0, False)
    assert axis.state == S.ENABLED
    seen = []
    for age_cycles in range(1, STALE + engage + 10):
        fault = BIT[F.FEEDBACK_STALE] if age_cycles >= STALE else 0
        step(axis, fault, age_cycles=age_cycles, fresh=clocked)
        seen.append(axis.unheard)
    first = seen.index(True) + 1 - STALE
    assert first == (engage + HANDSHAKE_SYNCS + 1 if clocked else HANDSHAKE_SYNCS + 1)


@pytest.mark.parametrize("by_drive", [True, False])
def test_a_coarse_sensor_of_a_drive_that_holds_rests_within_its_counts(by_drive: bool) -> None:
    brake = BrakeTimes(False, 0.01, 0.01) if by_drive else None
    axis = Axis(PERIOD_S, 0.01, 2.0, Mode.CYCLIC_SYNC_TORQUE, 1.0, brake=brake, stays_rad=2e-3)
    axis.enable(False)
    for _ in range(30):
        axis.step(amplifier(**READY), True, 0, False)
    axis.quick_stop()
    for number in range(30):
        step(axis, state=D.QUICK_STOP_ACTIVE, position_rad=1e-3 * (number % 2))
    assert axis.state == S.DISABLED


def test_a_drive_with_a_brake_of_its_own_may_hold_until_that_is_closed() -> None:
    for by_output, cycles in ((False, 133), (True, OBEY)):  # 0.03 and 0.1 s are 133.1
        brake = BrakeTimes(by_output, 0.1, 0.1)
        axis = Axis(PERIOD_S, 0.01, 10.0, Mode.CYCLIC_SYNC_TORQUE, 1.0, brake=brake)
        assert cycles_until_disobedience(axis, state=D.OPERATION_ENABLED) == cycles + 1


def test_one_obedient_cycle_begins_the_count_anew() -> None:
    axis = axis_in(S.DISABLED)
    for _ in range(OBEY):
        step(axis, state=D.OPERATION_ENABLED)
    step(axis, state=D.SWITCH_ON_DISABLED)
    assert cycles_until_disobedience(axis, state=D.OPERATION_ENABLED) == OBEY + 1


def test_count_begins_with_the_order_to_switch_off() -> None:
    axis = axis_in(S.DISABLED)
    for _ in range(OBEY):
        step(axis, state=D.OPERATION_ENABLED)
    axis.enable(False)
    step(axis, **READY)
    axis.quick_stop()
    assert cycles_until_disobedience(axis, state=D.OPERATION_ENABLED) == OBEY + 1


def test_quick_stop_may_hold_for_as_long_as_it_takes() -> None:
    axis = Axis(PERIOD_S, RAMP * PERIOD_S, 1000 * PERIOD_S, Mode.CYCLIC_SYNC_TORQUE, 1.0)
    axis.enable(False)
    step(axis, **READY)
    axis.quick_stop()
    assert cycles_until_disobedience(axis, state=D.QUICK_STOP_ACTIVE) == 0
    assert axis.state == S.QUICK_STOPPING


def test_a_drive_that_would_hold_in_quick_stop_active_is_switched_off_at_rest() -> None:
    """0x605A from 5 on: at rest for 20 ms, and no torque is left that nobody asked for; a ramp is waited for."""
    axis = Axis(PERIOD_S, RAMP * PERIOD_S, 1000 * PERIOD_S, Mode.CYCLIC_SYNC_TORQUE, 1.0, stays_rad=2e-4)
    axis.enable(False)
    step(axis, **READY)
    axis.quick_stop()
    for number in range(40):
        step(axis, state=D.QUICK_STOP_ACTIVE, position_rad=0.001 * number)
        assert axis.state == S.QUICK_STOPPING
    for _ in range(20):
        step(axis, state=D.QUICK_STOP_ACTIVE, position_rad=0.039)
    assert axis.state == S.DISABLED


@pytest.mark.parametrize("period_s", [1e-3, 5e-3, 1e-2])
def test_a_drive_that_is_not_heard_on_its_ramp_is_not_at_rest(period_s: float) -> None:
    """Voltage off would end the ramp, and the joint coast."""
    axis = Axis(period_s, 0.01, 1.0, Mode.CYCLIC_SYNC_TORQUE, 1.0, stale_cycles=50, stays_rad=2e-4)
    axis.enable(False)
    step(axis, **READY)
    axis.quick_stop()
    step(axis, state=D.QUICK_STOP_ACTIVE, position_rad=0.001)
    for age in range(1, 49):
        step(axis, state=D.QUICK_STOP_ACTIVE, position_rad=0.001, age_cycles=age)
        assert axis.goal == Goal.QUICK_STOP


@pytest.mark.parametrize("moving", [False, True])
def test_a_joint_that_the_controller_did_not_bring_to_rest_is_the_drives_to_stop(moving: bool) -> None:
    """A law that runs away does not follow its reference to rest: letting go then would lose the ramp."""
    axis = axis_in(S.ENABLED)
    axis.step(amplifier(**DRIVE[S.ENABLED]), True, BIT[F.SUPERVISOR_LOST], False, moving)
    assert axis.state == S.BRAKING
    for _ in range(RAMP + 1 if moving else 1):  # it has its time for that
        axis.step(amplifier(**DRIVE[S.ENABLED]), True, BIT[F.SUPERVISOR_LOST], True, moving)
    assert axis.state == (S.QUICK_STOPPING if moving else S.RAMPING)


def test_a_joint_that_begins_to_move_while_its_torque_goes_is_the_drives_to_stop() -> None:
    """Braking may end where a joint turns back: its load drove it to 0.7 rad/s until the ramp had switched it off."""
    axis = axis_in(S.RAMPING)
    axis.step(amplifier(**DRIVE[S.RAMPING]), True, 0, True, False)
    assert axis.state == S.RAMPING
    axis.step(amplifier(**DRIVE[S.RAMPING]), True, 0, True, True)
    assert (axis.state, axis.goal) == (S.QUICK_STOPPING, Goal.QUICK_STOP)


def test_a_drive_on_its_ramp_after_a_fault_is_left_to_it() -> None:
    axis = axis_in(S.ENABLED)
    step(axis, state=D.QUICK_STOP_ACTIVE, goal_reached=False)
    assert (axis.state, axis.goal) == (S.FAULT, Goal.QUICK_STOP)
    assert (axis.enable(True), axis.reset_fault()) == (Refusal.MOTION_RUNNING, Refusal.MOTION_RUNNING)
    step(axis, state=D.SWITCH_ON_DISABLED, goal_reached=False)
    assert (axis.state, axis.goal) == (S.FAULT, Goal.OFF)
    assert axis.enable(True) == Refusal.DONE


def test_slow_loop_gives_a_drive_four_cycles() -> None:
    axis = Axis(0.1, 0.1, 0.1, Mode.CYCLIC_SYNC_TORQUE, 1.0)
    assert cycles_until_disobedience(axis, state=D.OPERATION_ENABLED) == 5
