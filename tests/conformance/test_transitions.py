"""The automaton of CiA 402 as data: complete, decoded right, and every plan leads to its goal."""

from __future__ import annotations

import pytest

from servod.drivers.cia402_state import (
    ROUTES,
    STATE_OF_STATUS,
    TRANSITIONS,
    control_words,
    reached_states,
)
from servod.runtime.fieldbus.cia import (
    CW_FAULT_RESET,
    CW_QUICK_STOP,
    CW_SHUTDOWN,
    STATUS_WORD_TABLE,
    decode_status_word,
)
from servod.runtime.fieldbus.devices import DriveState, Goal

S = DriveState
STAYS, LEAVES = 6, 2  # two values of 0x605A


def test_all_transitions_are_there_once_and_in_order() -> None:
    assert [transition.number for transition in TRANSITIONS] == list(range(17))


@pytest.mark.parametrize(
    ("number", "source", "target"),
    [
        (2, S.SWITCH_ON_DISABLED, S.READY_TO_SWITCH_ON),
        (3, S.READY_TO_SWITCH_ON, S.SWITCHED_ON),
        (4, S.SWITCHED_ON, S.OPERATION_ENABLED),
        (5, S.OPERATION_ENABLED, S.SWITCHED_ON),
        (6, S.SWITCHED_ON, S.READY_TO_SWITCH_ON),
        (7, S.READY_TO_SWITCH_ON, S.SWITCH_ON_DISABLED),
        (8, S.OPERATION_ENABLED, S.READY_TO_SWITCH_ON),
        (9, S.OPERATION_ENABLED, S.SWITCH_ON_DISABLED),
        (10, S.SWITCHED_ON, S.SWITCH_ON_DISABLED),
        (11, S.OPERATION_ENABLED, S.QUICK_STOP_ACTIVE),
        (12, S.QUICK_STOP_ACTIVE, S.SWITCH_ON_DISABLED),
        (15, S.FAULT, S.SWITCH_ON_DISABLED),
        (16, S.QUICK_STOP_ACTIVE, S.OPERATION_ENABLED),
    ],
)
def test_commanded_transitions_have_their_words(number: int, source: DriveState, target: DriveState) -> None:
    transition = TRANSITIONS[number]
    assert (transition.source, transition.target) == (source, target)
    assert transition.words


def test_every_status_word_decodes_by_the_table_and_never_by_a_guess() -> None:
    for word in range(0x10000):
        rows = {state for mask, value, state in STATUS_WORD_TABLE if word & mask == value}
        assert len(rows) <= 1
        expected = rows.pop() if rows else S.UNKNOWN
        assert decode_status_word(word) is expected
        assert STATE_OF_STATUS[word & 0x7F] is expected


def next_state(state: DriveState, word: int, option: int) -> DriveState:
    """What a drive does: the transition whose words hold this one, else what it does by itself."""
    for transition in TRANSITIONS:
        if transition.source is state and word in transition.words:
            if transition.number == 16 and option < 5:
                continue
            return transition.target
    if state is S.QUICK_STOP_ACTIVE and option < 5:
        return S.SWITCH_ON_DISABLED  # 12, by itself
    if state in (S.NOT_READY_TO_SWITCH_ON, S.FAULT_REACTION_ACTIVE):
        return next(t.target for t in TRANSITIONS if t.source is state)
    return state


@pytest.mark.parametrize("option", [LEAVES, STAYS])
@pytest.mark.parametrize("goal", list(Goal))
@pytest.mark.parametrize("start", [state for state in DriveState if state is not S.UNKNOWN])
def test_the_plan_leads_from_every_state_to_the_goal_and_stays(start: DriveState, goal: Goal, option: int) -> None:
    words, reached = control_words(option), reached_states(option)
    state, path = start, [start]
    for _ in range(8):
        state = next_state(state, words[goal][state], option)
        path.append(state)
    if S.FAULT in path and goal in (Goal.ENABLED, Goal.READY):
        assert state is S.FAULT  # no way out without a reset
    else:
        assert reached[goal][state], path
        assert path[-1] is path[-2], "the goal does not hold"


def test_no_plan_ever_asks_for_more_power_than_the_goal_has() -> None:
    for option in (LEAVES, STAYS):
        words = control_words(option)
        for state in DriveState:
            assert words[Goal.OFF][state] == 0
            assert words[Goal.QUICK_STOP][state] == CW_QUICK_STOP
            assert words[Goal.READY][state] in (0, CW_SHUTDOWN)
        assert not any(word & CW_FAULT_RESET for row in words for word in row)


def test_a_quick_stop_ramp_is_not_cut_short() -> None:
    assert not reached_states(LEAVES)[Goal.QUICK_STOP][S.QUICK_STOP_ACTIVE]
    assert reached_states(STAYS)[Goal.QUICK_STOP][S.QUICK_STOP_ACTIVE]
    assert control_words(LEAVES)[Goal.ENABLED][S.QUICK_STOP_ACTIVE] == CW_QUICK_STOP


def test_routes_start_where_their_transition_starts() -> None:
    for routes in ROUTES.values():
        assert all(TRANSITIONS[number].source is state for state, number in routes.items())
