"""The cycle face of the CiA 402 driver at its edges: no slow PDO, cut frames, emergencies, reasons."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "conformance"))
from drivers_under_test import AmplifierBench, encode

from servod.runtime.fieldbus.cia import EMCY_BASE, Obj402
from servod.runtime.fieldbus.devices import (
    HANDSHAKE_SYNCS,
    NEVER_CYCLES,
    AmplifierCommand,
    DriveInput,
    DriveState,
    Goal,
    Mode,
    Reason,
)
from servod.runtime.fieldbus.registry import load_driver

S = DriveState


def bench(slow: bool = True, **options: object) -> AmplifierBench:
    made = AmplifierBench("cia402", **options)
    if not slow:
        pdos = tuple(pdo for pdo in made.plan.pdos if pdo is not made.slow_pdo)
        made.driver = load_driver("cia402").cyclic(dataclasses.replace(made.plan, pdos=pdos))
    return made


def test_drive_without_a_slow_pdo_is_taken_at_its_word() -> None:
    axis = bench(slow=False)
    assert len(axis.driver.receive_ids) == 2
    assert axis.say_mode(Mode.PROFILE_TORQUE) is False
    for _ in range(HANDSHAKE_SYNCS + 2):
        word, torque = axis.cycle(S.OPERATION_ENABLED, Goal.ENABLED, 0.5)
    assert (word, torque != 0) == (0x0F, True)
    axis.say(S.OPERATION_ENABLED)
    assert (axis.driver.read().mode, axis.driver.read().goal_reached) == (-1, True)


@pytest.mark.parametrize("length", range(9))
@pytest.mark.parametrize("which", ["feedback", "slow", "emcy"])
def test_frames_count_from_their_full_length_on(which: str, length: int) -> None:
    axis = bench()
    can_id, whole = {
        "feedback": (axis.feedback_pdo.cob_id, 8),
        "slow": (axis.slow_pdo.cob_id, 3),
        "emcy": (EMCY_BASE + axis.plan.node_id, 8),
    }[which]
    taken = axis.driver.on_frame(can_id, bytes(length), 1)
    assert taken is (which == "feedback" and length >= whole)
    assert axis.driver.ignored_frames == int(length < whole)  # type: ignore[attr-defined]


@pytest.mark.parametrize("data", [b"\x50\x82" + bytes(6), b""])
def test_frames_of_others_are_no_ones(data: bytes) -> None:
    axis = bench()
    axis.say(S.SWITCHED_ON)
    mine = EMCY_BASE + axis.plan.node_id
    for can_id in (axis.feedback_pdo.cob_id + 1, EMCY_BASE, mine - 1, mine + 1, axis.command_pdo.cob_id, 0x7FF):
        assert axis.driver.on_frame(can_id, data, 1) is False
    assert axis.driver.ignored_frames == 0  # type: ignore[attr-defined]
    assert (axis.driver.read().error_code, axis.driver.read().reasons & Reason.COMMANDS_MISSED) == (0, 0)


@pytest.mark.parametrize(("code", "missed"), [(0x8250, True), (0x8251, False), (0x8130, False), (0x0000, False)])
def test_emergency_of_the_commands_deadline_is_a_reason(code: int, missed: bool) -> None:
    axis = bench()
    axis.say(S.SWITCHED_ON)
    axis.say_emcy(code)
    assert bool(axis.driver.read().reasons & Reason.COMMANDS_MISSED) is missed
    assert axis.driver.read().error_code == code


@pytest.mark.parametrize(("code", "gone"), [(0x0000, True), (0x00FF, True), (0x0100, False), (0x2310, False)])
def test_emergency_is_taken_back_by_error_reset_alone(code: int, gone: bool) -> None:
    axis = bench()
    axis.say(S.SWITCHED_ON)
    axis.say_emcy(0x8250)
    axis.say_emcy(code)
    assert bool(axis.driver.read().reasons & Reason.COMMANDS_MISSED) is not gone


def waited(axis: AmplifierBench, state: DriveState, goal: Goal, flags: int = 0) -> int:
    """Reasons after the handshake."""
    for _ in range(HANDSHAKE_SYNCS + 1):
        axis.say(state, flags=flags)
        axis.ask(goal)
    axis.say(state, flags=flags)
    return axis.driver.read().reasons


@pytest.mark.parametrize("option", [2, 6])
def test_quick_stop_that_holds_is_named(option: int) -> None:
    held = waited(bench(quick_stop_option=option), S.QUICK_STOP_ACTIVE, Goal.READY)
    assert bool(held & Reason.QUICK_STOP_HOLDS) is (option == 6)


def test_drive_that_takes_no_commands_from_the_bus_is_named() -> None:
    axis = bench()
    for _ in range(HANDSHAKE_SYNCS + 2):
        data = encode(axis.feedback_pdo, {Obj402.STATUS_WORD: 0x0040})  # switch on disabled; no voltage, no remote
        axis.driver.on_frame(axis.feedback_pdo.cob_id, data, 1)
        axis.driver.write(AmplifierCommand(Goal.ENABLED, 0.0))
    axis.driver.on_frame(axis.feedback_pdo.cob_id, data, 1)
    wanted = Reason.NO_VOLTAGE | Reason.REMOTE_OFF | Reason.MODE_NOT_SHOWN
    assert axis.driver.read().reasons & wanted == wanted


@pytest.mark.parametrize(
    ("word", "goal", "reason"),
    [
        (0x0240, Goal.READY, Reason.NO_VOLTAGE),
        (0x0221, Goal.OFF, Reason.HANDSHAKE),  # ready to switch on: nothing is named that a user could mend
        (0x0200, Goal.READY, Reason.NOT_READY),
    ],
)
def test_voltage_is_missed_only_where_it_is_needed_next(word: int, goal: Goal, reason: Reason) -> None:
    axis = bench()
    data = encode(axis.feedback_pdo, {Obj402.STATUS_WORD: word})
    for _ in range(HANDSHAKE_SYNCS + 2):
        axis.driver.on_frame(axis.feedback_pdo.cob_id, data, 1)
        found = axis.driver.read().reasons
        axis.driver.write(AmplifierCommand(goal, 0.0))
    assert found == reason


@pytest.mark.parametrize("mode", [-1, 0, Mode.PROFILE_TORQUE, Mode.CYCLIC_SYNC_VELOCITY, 11])
def test_goal_that_is_reached_in_a_wrong_mode_says_so(mode: int) -> None:
    axis = bench()
    axis.say_mode(mode)
    assert waited(axis, S.OPERATION_ENABLED, Goal.ENABLED) == Reason.MODE_NOT_SHOWN


# --- feedback ---------------------------------------------------------------------------------------------------------
def test_before_the_first_frame_nothing_is_claimed() -> None:
    nothing = (0, NEVER_CYCLES, S.UNKNOWN, 0, -1, 0.0, 0.0, 0, False, Reason.NO_FEEDBACK, 0)
    assert tuple(bench().driver.read()) == nothing


def test_zero_of_the_wire_is_zero_and_each_frame_has_its_time() -> None:
    axis = bench()
    axis.say(S.SWITCHED_ON)
    assert axis.driver.read()[:7] == (axis.time_ns, 0, S.SWITCHED_ON, 0x0233, -1, 0.0, 0.0)


@pytest.mark.parametrize("start", [0, 1, -(2**31), 2**31 - 1])
@pytest.mark.parametrize("step", [0, 1, -1, 2**31 - 1, -(2**31), 2**30 + 1])
def test_motors_position_goes_the_shortest_way_to_the_last_count(start: int, step: int) -> None:
    axis = bench()
    axis.say(S.SWITCHED_ON, position=start)
    first = axis.driver.read().position_rad
    axis.say(S.SWITCHED_ON, position=start + step)
    moved = (axis.driver.read().position_rad - first) * 1_000_000 / 6.283185307179586
    assert moved == pytest.approx(step, abs=1e-5)


@pytest.mark.parametrize("state", [S.SWITCHED_ON, S.OPERATION_ENABLED, S.QUICK_STOP_ACTIVE])
@pytest.mark.parametrize("said", [False, True])
def test_mode_is_lost_after_three_event_timers_and_ten_cycles(said: bool, state: DriveState) -> None:
    axis = bench()
    if said:
        for _ in range(5):
            axis.cycle(state, Goal.ENABLED)
        axis.say_mode(Mode.CYCLIC_SYNC_TORQUE)
    for _ in range(310):  # of 1 ms
        axis.cycle(state, Goal.ENABLED)
    axis.say(state)
    kept = Mode.CYCLIC_SYNC_TORQUE if said else -1
    assert axis.driver.read().mode == kept
    assert bool(axis.driver.read().reasons & Reason.MODE_NOT_SHOWN) is not said
    axis.cycle(state, Goal.ENABLED)
    axis.say(state)
    assert axis.driver.read().mode == (Mode.NONE if state == S.OPERATION_ENABLED else -1)
    assert axis.driver.read().reasons & Reason.MODE_NOT_SHOWN


def test_feedback_counts_until_it_is_as_old_as_the_handshake() -> None:
    axis, old = bench(), []
    axis.say(S.SWITCH_ON_DISABLED)
    for _ in range(HANDSHAKE_SYNCS + 3):
        old.append(int(axis.driver.read().reasons))
        axis.ask(Goal.OFF)
    assert old == [0] * HANDSHAKE_SYNCS + [Reason.NO_FEEDBACK] * 3


@pytest.mark.parametrize(
    ("goal", "state"),
    [
        (Goal.OFF, S.SWITCH_ON_DISABLED),
        (Goal.READY, S.READY_TO_SWITCH_ON),
        (Goal.QUICK_STOP, S.SWITCH_ON_DISABLED),
    ],
)
def test_mode_matters_to_the_goal_of_being_enabled_alone(goal: Goal, state: DriveState) -> None:
    axis = bench()
    axis.say_mode(Mode.PROFILE_TORQUE)
    assert waited(axis, state, goal) == Reason.NONE


def test_reasons_come_beside_each_other() -> None:
    axis = bench()
    axis.say_mode(Mode.PROFILE_TORQUE)
    axis.cycle(S.OPERATION_ENABLED, Goal.ENABLED, halt=True)
    axis.say_emcy(0x8250)
    axis.say(S.OPERATION_ENABLED)
    wanted = Reason.HALTED | Reason.MODE_NOT_SHOWN | Reason.COMMANDS_MISSED
    assert (axis.driver.read().reasons, axis.driver.read().goal_reached) == (wanted, False)


@pytest.mark.parametrize("goal", list(Goal))
@pytest.mark.parametrize("state", list(S))
@pytest.mark.parametrize("option", [2, 6])
def test_every_reason_in_every_state_after_the_handshake(option: int, state: DriveState, goal: Goal) -> None:
    axis = bench(quick_stop_option=option)
    axis.say_mode(Mode.PROFILE_TORQUE)
    still = (S.NOT_READY_TO_SWITCH_ON, S.SWITCH_ON_DISABLED, S.FAULT)
    there = {Goal.OFF: still, Goal.READY: (S.READY_TO_SWITCH_ON,), Goal.ENABLED: (S.OPERATION_ENABLED,)}
    there[Goal.QUICK_STOP] = still if option == 2 else (*still, S.QUICK_STOP_ACTIVE)
    mode = Reason.MODE_NOT_SHOWN if goal == Goal.ENABLED else Reason.NONE
    beside = {S.NOT_READY_TO_SWITCH_ON: Reason.NOT_READY}
    if option == 6:
        beside[S.QUICK_STOP_ACTIVE] = Reason.QUICK_STOP_HOLDS
    if state == S.UNKNOWN:
        expected = Reason.STATE_UNKNOWN
    elif state in there[goal]:
        expected = mode
    elif state in (S.FAULT, S.FAULT_REACTION_ACTIVE):
        expected = Reason.IN_FAULT
    else:
        expected = beside.get(state, Reason.NONE) | mode or Reason.HANDSHAKE
    assert waited(axis, state, goal) == expected


@pytest.mark.parametrize(
    ("word", "levels", "active"),
    [
        (0x30000, ("low", "low"), DriveInput(0)),
        (0x20000, ("low", "low"), DriveInput.ESTOP),
        (0x10000, ("low", "low"), DriveInput.STO),
        (0x0FFFF, ("low", "low"), DriveInput.ESTOP | DriveInput.STO),
        (0x30000, ("high", "low"), DriveInput.ESTOP),
        (0x20000, ("high", "high"), DriveInput.STO),
        (0xFFFCFFFF, ("high", "high"), DriveInput(0)),
    ],
)
def test_inputs_are_active_by_their_level(word: int, levels: tuple[str, str], active: DriveInput) -> None:
    inputs = {"estop_bit": 16, "estop_active": levels[0], "sto_bit": 17, "sto_active": levels[1]}
    axis = bench(inputs=inputs)
    axis.say(S.SWITCH_ON_DISABLED)
    assert axis.driver.read().inputs == 0, "not heard yet, and not missing yet"
    say_inputs(axis, word)
    assert axis.driver.read().inputs == active


def say_inputs(axis: AmplifierBench, word: int, error_code: int = 0) -> None:
    values = {Obj402.MODE_DISPLAY: Mode.CYCLIC_SYNC_TORQUE, Obj402.ERROR_CODE: error_code}
    data = encode(axis.slow_pdo, values | {Obj402.DIGITAL_INPUTS: word})
    axis.driver.on_frame(axis.slow_pdo.cob_id, data, axis.time_ns)


@pytest.mark.parametrize("level", ["low", "high"])
def test_inputs_that_are_not_heard_any_more_are_active(level: str) -> None:
    axis = bench(inputs={"estop_bit": 3, "estop_active": level})
    say_inputs(axis, 8 if level == "low" else 0)
    seen = []
    for _ in range(45):
        axis.cycle(S.OPERATION_ENABLED, Goal.ENABLED)
        axis.say(S.OPERATION_ENABLED)
        seen.append(axis.driver.read().inputs)
    assert seen == 40 * [0] + 5 * [DriveInput.ESTOP], "three event timers of 10 ms and ten cycles"
    say_inputs(axis, 8 if level == "low" else 0)
    assert axis.driver.read().inputs == 0


def test_active_input_is_not_hidden_by_who_says_that_it_is_released() -> None:
    axis = bench(inputs={"estop_bit": 3, "estop_active": "high"})
    seen = set()
    for number in range(200):
        axis.cycle(S.OPERATION_ENABLED, Goal.ENABLED)
        if number % 10 == 0:
            say_inputs(axis, 8)  # the drive, by its event timer
        say_inputs(axis, 0)  # somebody else, behind it and in each cycle
        seen.add(axis.driver.read().inputs)
    assert seen == {DriveInput.ESTOP}
    for _ in range(45):
        axis.cycle(S.OPERATION_ENABLED, Goal.ENABLED)
        say_inputs(axis, 0)
    assert axis.driver.read().inputs == 0, "released, and nobody says otherwise"


def test_sto_is_told_by_the_drives_error_code_while_it_is_in_fault() -> None:
    axis = bench(inputs={"sto_error": 0x5441})
    told = []
    for state in (S.SWITCHED_ON, S.FAULT, S.FAULT_REACTION_ACTIVE, S.READY_TO_SWITCH_ON):
        axis.say(state)
        axis.say_emcy(0x4310 if state is S.SWITCHED_ON else 0x5441)
        told.append(axis.driver.read().inputs)
    axis.say(S.FAULT)
    axis.say_emcy(0x4310)
    assert [*told, axis.driver.read().inputs] == [0, DriveInput.STO_TOLD, DriveInput.STO_TOLD, 0, 0]
