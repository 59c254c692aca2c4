"""The command side of the CiA 402 driver, cycle by cycle: halt, fault reset, handshake, and what goes out instead."""

from __future__ import annotations

import dataclasses
import math
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "conformance"))
from drivers_under_test import AmplifierBench, axis_config, decode, encode, find_pdo

from servod.drivers.cia402 import Cia402Amplifier
from servod.drivers.cia402_setup import AmplifierSetup
from servod.runtime.fieldbus.cia import CW_FAULT_RESET, CW_HALT, Obj402
from servod.runtime.fieldbus.devices import HANDSHAKE_SYNCS, AmplifierCommand, DriveState, Goal, Mode, Reason

S = DriveState
KEPT, LEFT = 6, 2  # 0x605A: the drive stays in quick stop active, or leaves it


def bench(**options: object) -> AmplifierBench:
    made = AmplifierBench("cia402", **options)
    made.say_mode(Mode.CYCLIC_SYNC_TORQUE)
    return made


# --- what goes out ----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("state", list(S))
@pytest.mark.parametrize("goal", list(Goal))
def test_halt_goes_with_the_word_that_enables_and_with_no_other(goal: Goal, state: DriveState) -> None:
    plain, _ = bench().cycle(state, goal, 0.5)
    halted, _ = bench().cycle(state, goal, 0.5, halt=True)
    assert halted == plain | (CW_HALT if plain == 0x0F else 0)


@pytest.mark.parametrize("goal", list(Goal))
@pytest.mark.parametrize("state", list(S))
@pytest.mark.parametrize("option", [KEPT, LEFT])
def test_torque_now_produced_is_carried_only_out_of_a_quick_stop(option: int, state: DriveState, goal: Goal) -> None:
    axis = bench(quick_stop_option=option)
    axis.say_mode(Mode.PROFILE_TORQUE)  # the command itself means nothing in it
    axis.say(state, torque=-123)
    word, torque = axis.ask(goal, 0.5)
    carried = (option, state, goal) == (KEPT, S.QUICK_STOP_ACTIVE, Goal.ENABLED)
    assert torque == (-123 if carried else 0)
    assert word == 0x0F or not carried


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_torque_that_is_none_gives_zero_and_not_the_one_that_is_produced(bad: float) -> None:
    axis = bench()
    axis.say(S.OPERATION_ENABLED, torque=77)
    assert axis.ask(Goal.ENABLED, bad) == (0, 0)


def test_objects_of_the_command_go_out_in_the_planned_order() -> None:
    axis = bench()
    turned = dataclasses.replace(axis.command_pdo, entries=tuple(reversed(axis.command_pdo.entries)))
    pdos = tuple(turned if pdo is axis.command_pdo else pdo for pdo in axis.plan.pdos)
    axis.command_pdo, axis.driver = turned, Cia402Amplifier(dataclasses.replace(axis.plan, pdos=pdos))
    assert axis.cycle(S.OPERATION_ENABLED, Goal.ENABLED, 0.5) == (0x0F, 250)


def test_set_point_of_profile_position_goes_out_with_its_bits_and_starts_at_zero() -> None:
    plan = AmplifierSetup(axis_config(), Mode.PROFILE_POSITION).plan()
    driver, command = Cia402Amplifier(plan), find_pdo(plan, Obj402.CONTROL_WORD)

    def sent() -> tuple[int, int]:
        _, data = driver.write(AmplifierCommand(Goal.ENABLED, 0.0, setpoint=math.pi))
        return decode(command, data, Obj402.CONTROL_WORD), decode(command, data, Obj402.TARGET_POSITION)

    assert sent() == (0, 0), "before the drive said anything"
    feedback = find_pdo(plan, Obj402.STATUS_WORD)
    for status_word, bits in ((0x0237, 0x30), (0x1237, 0x20), (0x0237, 0x20)):
        driver.on_frame(feedback.cob_id, encode(feedback, {Obj402.STATUS_WORD: status_word}), 1)
        assert sent() == (0x0F | bits, 500_000)


# --- fault reset ------------------------------------------------------------------------------------------------------
def resets(pattern: str, states: str = "", goal: Goal = Goal.OFF) -> str:
    """Bit 7 in each cycle, for requests in `pattern` and a drive in fault, or out of it where `states` has a dot."""
    axis, bits = bench(), ""
    for requested, state in zip(pattern, states or "F" * len(pattern), strict=True):
        drive = S.FAULT if state == "F" else S.SWITCH_ON_DISABLED
        word, _ = axis.cycle(drive, goal, reset_fault=requested == "1")
        bits += "1" if word & CW_FAULT_RESET else "0"
    return bits


@pytest.mark.parametrize(
    ("pattern", "bits"),
    [
        ("1000000", "1110000"),  # held for the handshake, so that one lost frame is no harm
        ("1111111", "1110000"),  # a request that stays is one
        ("1010000000", "1110111000"),  # the second one waits for its own edge
        ("1010100000000000", "1110111011100000"),
        ("101010101010" + "0" * 14, "11101110111011101110000000"),  # no more than two wait
        ("10101010" + "0" * 14, "1110111011101110000000"),
    ],
)
@pytest.mark.parametrize("goal", list(Goal))
def test_requests_of_a_reset_give_their_edges(goal: Goal, pattern: str, bits: str) -> None:
    assert resets(pattern, goal=goal) == bits


def test_reset_holds_its_time_and_is_not_kept_for_the_next_fault() -> None:
    assert resets("10000000", "F.......") == "11100000", "the edge is held while the drive leaves the fault"
    assert resets("10000000", ".FFFFFFF") == "00000000"
    assert resets("1010000000", "FFFF.FFFFF") == "1110000000", "two requests, and the first has helped"


# --- the handshake ----------------------------------------------------------------------------------------------------
def reasons_while(axis: AmplifierBench, goal: Goal, cycles: int, **flags: bool) -> list[int]:
    """Reasons of a drive that stays in fault, after each command."""
    found = []
    for _ in range(cycles):
        axis.ask(goal, **flags)
        axis.say(S.FAULT_REACTION_ACTIVE)
        found.append(int(axis.driver.read().reasons))
    return found


WAIT, FAULT = int(Reason.HANDSHAKE), int(Reason.IN_FAULT)


def test_handshake_waits_three_cycles_after_each_new_goal_or_word() -> None:
    axis = bench()
    axis.say(S.FAULT_REACTION_ACTIVE)
    axis.ask(Goal.READY)
    assert reasons_while(axis, Goal.ENABLED, 5) == [WAIT] * HANDSHAKE_SYNCS + [FAULT] * 2, "a goal, the same word"
    assert reasons_while(axis, Goal.READY, 5) == [WAIT] * HANDSHAKE_SYNCS + [FAULT] * 2
    assert reasons_while(axis, Goal.QUICK_STOP, 5) == [WAIT] * HANDSHAKE_SYNCS + [FAULT] * 2
    axis.say(S.SWITCHED_ON)
    axis.ask(Goal.READY)
    for _ in range(5):
        axis.say(S.SWITCHED_ON)
        axis.ask(Goal.READY)
    axis.say(S.FAULT_REACTION_ACTIVE)
    assert reasons_while(axis, Goal.READY, 5) == [WAIT] * HANDSHAKE_SYNCS + [FAULT] * 2, "a word, the same goal"


def test_handshake_waits_for_a_word_that_asks_for_more_too() -> None:
    axis, found = bench(), []
    for _ in range(HANDSHAKE_SYNCS + 2):
        axis.cycle(S.NOT_READY_TO_SWITCH_ON, Goal.READY)
    data = encode(axis.feedback_pdo, {Obj402.STATUS_WORD: 0x0240})  # switch on disabled, no voltage: shutdown is sent
    for _ in range(6):
        axis.driver.on_frame(axis.feedback_pdo.cob_id, data, 1)
        found.append(axis.driver.read().reasons)
        axis.ask(Goal.READY)
    assert found == [Reason.NO_VOLTAGE] + [WAIT] * HANDSHAKE_SYNCS + [Reason.NO_VOLTAGE] * 2


def test_no_handshake_is_waited_for_before_the_first_command() -> None:
    axis = bench()
    axis.say(S.FAULT_REACTION_ACTIVE)
    assert axis.driver.read().reasons == Reason.IN_FAULT
