"""CiA 402 as the standard prints it: transitions, status words and control words, written down a second time.

The tables here are copied from the standard, not from the code; `scripts/mutate.py cia402_state cia` shows that no
changed number or row of the code goes unnoticed.
"""

from __future__ import annotations

import pytest

from servod.drivers.cia402_state import (
    ROUTES,
    STATE_OF_STATUS,
    TRANSITIONS,
    control_words,
    quick_stop_stays,
    reached_states,
)
from servod.formats import config_wire
from servod.runtime.fieldbus.cia import decode_status_word
from servod.runtime.fieldbus.devices import DriveState, Goal

S = DriveState
SHUTDOWN, SWITCH_ON, ENABLE, VOLTAGE_OFF, QUICK_STOP, RESET = 0x06, 0x07, 0x0F, 0x00, 0x02, 0x80

#: Number, from, to, commands (CiA 402-2, figure and table of the finite state automaton).
PRINTED = [
    (0, S.UNKNOWN, S.NOT_READY_TO_SWITCH_ON, ()),
    (1, S.NOT_READY_TO_SWITCH_ON, S.SWITCH_ON_DISABLED, ()),
    (2, S.SWITCH_ON_DISABLED, S.READY_TO_SWITCH_ON, (SHUTDOWN,)),
    (3, S.READY_TO_SWITCH_ON, S.SWITCHED_ON, (SWITCH_ON,)),
    (4, S.SWITCHED_ON, S.OPERATION_ENABLED, (ENABLE,)),
    (5, S.OPERATION_ENABLED, S.SWITCHED_ON, (SWITCH_ON,)),
    (6, S.SWITCHED_ON, S.READY_TO_SWITCH_ON, (SHUTDOWN,)),
    (7, S.READY_TO_SWITCH_ON, S.SWITCH_ON_DISABLED, (VOLTAGE_OFF, QUICK_STOP)),
    (8, S.OPERATION_ENABLED, S.READY_TO_SWITCH_ON, (SHUTDOWN,)),
    (9, S.OPERATION_ENABLED, S.SWITCH_ON_DISABLED, (VOLTAGE_OFF,)),
    (10, S.SWITCHED_ON, S.SWITCH_ON_DISABLED, (VOLTAGE_OFF, QUICK_STOP)),
    (11, S.OPERATION_ENABLED, S.QUICK_STOP_ACTIVE, (QUICK_STOP,)),
    (12, S.QUICK_STOP_ACTIVE, S.SWITCH_ON_DISABLED, (VOLTAGE_OFF,)),
    (13, None, S.FAULT_REACTION_ACTIVE, ()),
    (14, S.FAULT_REACTION_ACTIVE, S.FAULT, ()),
    (15, S.FAULT, S.SWITCH_ON_DISABLED, (RESET,)),
    (16, S.QUICK_STOP_ACTIVE, S.OPERATION_ENABLED, (ENABLE,)),
]


def test_every_transition_is_the_printed_one() -> None:
    assert [tuple(transition) for transition in TRANSITIONS] == PRINTED


#: Bits 6, 5, 3, 2, 1, 0 of the status word; x is either (CiA 402-2, table of the status word).
STATUS = {
    "0x0000": S.NOT_READY_TO_SWITCH_ON,
    "1x0000": S.SWITCH_ON_DISABLED,
    "010001": S.READY_TO_SWITCH_ON,
    "010011": S.SWITCHED_ON,
    "010111": S.OPERATION_ENABLED,
    "000111": S.QUICK_STOP_ACTIVE,
    "0x1111": S.FAULT_REACTION_ACTIVE,
    "0x1000": S.FAULT,
}


def test_every_status_word_is_the_printed_state_or_unknown() -> None:
    for word in range(0x10000):
        bits = "".join("01"[word >> bit & 1] for bit in (6, 5, 3, 2, 1, 0))
        rows = [s for row, s in STATUS.items() if all(p in ("x", b) for p, b in zip(row, bits, strict=True))]
        assert decode_status_word(word) is (rows[0] if rows else S.UNKNOWN), hex(word)
    assert len(STATE_OF_STATUS) == 128
    assert all(STATE_OF_STATUS[word] is decode_status_word(word) for word in range(128))


#: What is sent in each state, in the order of the states: unknown, not ready, disabled, ready, on, enabled, quick stop,
#: fault reaction, fault. `-` is disable voltage.
PLANS = {
    Goal.OFF: (0, 0, 0, 0, 0, 0, 0, 0, 0),
    Goal.READY: (0, 0, SHUTDOWN, SHUTDOWN, SHUTDOWN, SHUTDOWN, VOLTAGE_OFF, 0, 0),
    Goal.ENABLED: (0, 0, SHUTDOWN, SWITCH_ON, ENABLE, ENABLE, ENABLE, 0, 0),
    Goal.QUICK_STOP: (QUICK_STOP,) * 9,
}


@pytest.mark.parametrize("option", range(9))
@pytest.mark.parametrize("goal", list(Goal))
def test_every_control_word_is_planned_as_documented(goal: Goal, option: int) -> None:
    plan = list(PLANS[goal])
    if goal == Goal.ENABLED and option < 5:
        plan[S.QUICK_STOP_ACTIVE] = QUICK_STOP
    assert list(control_words(option)[goal]) == plan


@pytest.mark.parametrize("option", range(9))
def test_every_goal_is_reached_where_documented(option: int) -> None:
    still = {S.NOT_READY_TO_SWITCH_ON, S.SWITCH_ON_DISABLED, S.FAULT}
    stopped = still | {S.QUICK_STOP_ACTIVE} if option >= 5 else still
    where = {Goal.OFF: still, Goal.READY: {S.READY_TO_SWITCH_ON}, Goal.ENABLED: {S.OPERATION_ENABLED}}
    where[Goal.QUICK_STOP] = stopped
    assert quick_stop_stays(option) is config_wire.quick_stop_stays(option) is (option in (5, 6, 7, 8))
    for goal in Goal:
        assert {state for state in DriveState if reached_states(option)[goal][state]} == where[goal]


def test_routes_are_by_number() -> None:
    assert {goal: sorted(route.values()) for goal, route in ROUTES.items()} == {
        Goal.OFF: [7, 9, 10, 12],
        Goal.READY: [2, 6, 8, 12],
        Goal.ENABLED: [2, 3, 4, 16],
        Goal.QUICK_STOP: [7, 10, 11],
    }
