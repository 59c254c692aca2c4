"""The CiA 402 power drive system as data: every transition, and the control word for each present state and goal.

Step (2) and (5) of the cycle stand on these tables: `STATE_OF_STATUS` decodes, `control_words` plans. Nothing here has
state; the plan follows from the present state and the goal alone, so a transient state may be missed without harm.
Source: CiA 402-2, finite state automaton (transitions 0 to 16) and the tables of status word and control word.
"""

from __future__ import annotations

from typing import NamedTuple

from servod.runtime.fieldbus.cia import (
    CW_DISABLE_VOLTAGE,
    CW_ENABLE_OPERATION,
    CW_FAULT_RESET,
    CW_QUICK_STOP,
    CW_SHUTDOWN,
    CW_SWITCH_ON,
    decode_status_word,
)
from servod.runtime.fieldbus.devices import DriveState, Goal

_S = DriveState


class Transition(NamedTuple):
    """One arrow of the automaton; `words` are the control words that cause it, none when the drive acts by itself."""

    number: int
    source: DriveState | None  # None: from any state
    target: DriveState
    words: tuple[int, ...]


#: All transitions of CiA 402-2. UNKNOWN as source of transition 0 is "start": the drive has not said anything yet.
TRANSITIONS: tuple[Transition, ...] = (
    Transition(0, _S.UNKNOWN, _S.NOT_READY_TO_SWITCH_ON, ()),  # power on or reset
    Transition(1, _S.NOT_READY_TO_SWITCH_ON, _S.SWITCH_ON_DISABLED, ()),  # self-test done
    Transition(2, _S.SWITCH_ON_DISABLED, _S.READY_TO_SWITCH_ON, (CW_SHUTDOWN,)),
    Transition(3, _S.READY_TO_SWITCH_ON, _S.SWITCHED_ON, (CW_SWITCH_ON,)),
    Transition(4, _S.SWITCHED_ON, _S.OPERATION_ENABLED, (CW_ENABLE_OPERATION,)),
    Transition(5, _S.OPERATION_ENABLED, _S.SWITCHED_ON, (CW_SWITCH_ON,)),  # "disable operation", 0x605C
    Transition(6, _S.SWITCHED_ON, _S.READY_TO_SWITCH_ON, (CW_SHUTDOWN,)),
    Transition(7, _S.READY_TO_SWITCH_ON, _S.SWITCH_ON_DISABLED, (CW_DISABLE_VOLTAGE, CW_QUICK_STOP)),
    Transition(8, _S.OPERATION_ENABLED, _S.READY_TO_SWITCH_ON, (CW_SHUTDOWN,)),  # 0x605B
    Transition(9, _S.OPERATION_ENABLED, _S.SWITCH_ON_DISABLED, (CW_DISABLE_VOLTAGE,)),
    Transition(10, _S.SWITCHED_ON, _S.SWITCH_ON_DISABLED, (CW_DISABLE_VOLTAGE, CW_QUICK_STOP)),
    Transition(11, _S.OPERATION_ENABLED, _S.QUICK_STOP_ACTIVE, (CW_QUICK_STOP,)),  # 0x605A
    Transition(12, _S.QUICK_STOP_ACTIVE, _S.SWITCH_ON_DISABLED, (CW_DISABLE_VOLTAGE,)),  # or by itself, 0x605A 0 to 4
    Transition(13, None, _S.FAULT_REACTION_ACTIVE, ()),  # a fault
    Transition(14, _S.FAULT_REACTION_ACTIVE, _S.FAULT, ()),  # 0x605E done
    Transition(15, _S.FAULT, _S.SWITCH_ON_DISABLED, (CW_FAULT_RESET,)),  # rising edge, cause gone
    Transition(16, _S.QUICK_STOP_ACTIVE, _S.OPERATION_ENABLED, (CW_ENABLE_OPERATION,)),  # only 0x605A 5 to 8
)

#: Which transition to ask for in each state to come nearer to the goal. FAULT is left only by an explicit reset.
ROUTES: dict[Goal, dict[DriveState, int]] = {
    Goal.OFF: {_S.READY_TO_SWITCH_ON: 7, _S.SWITCHED_ON: 10, _S.OPERATION_ENABLED: 9, _S.QUICK_STOP_ACTIVE: 12},
    Goal.READY: {_S.SWITCH_ON_DISABLED: 2, _S.SWITCHED_ON: 6, _S.OPERATION_ENABLED: 8, _S.QUICK_STOP_ACTIVE: 12},
    Goal.ENABLED: {_S.SWITCH_ON_DISABLED: 2, _S.READY_TO_SWITCH_ON: 3, _S.SWITCHED_ON: 4, _S.QUICK_STOP_ACTIVE: 16},
    Goal.QUICK_STOP: {_S.READY_TO_SWITCH_ON: 7, _S.SWITCHED_ON: 10, _S.OPERATION_ENABLED: 11},
}

#: What to send where nothing is asked for: the goal's state itself is held, everywhere else the safe word is sent.
_HOLD: dict[Goal, tuple[DriveState, int, int]] = {
    Goal.OFF: (_S.SWITCH_ON_DISABLED, CW_DISABLE_VOLTAGE, CW_DISABLE_VOLTAGE),
    Goal.READY: (_S.READY_TO_SWITCH_ON, CW_SHUTDOWN, CW_DISABLE_VOLTAGE),
    Goal.ENABLED: (_S.OPERATION_ENABLED, CW_ENABLE_OPERATION, CW_DISABLE_VOLTAGE),
    Goal.QUICK_STOP: (_S.QUICK_STOP_ACTIVE, CW_QUICK_STOP, CW_QUICK_STOP),
}

#: There a goal of OFF or QUICK_STOP has nothing left to do; from the other states without power OFF goes on to these.
_AT_OFF = frozenset({_S.NOT_READY_TO_SWITCH_ON, _S.SWITCH_ON_DISABLED, _S.FAULT})


def quick_stop_stays(quick_stop_option: int) -> bool:
    """As that of servod.formats.config_wire, which loads more than the cycle has use for."""
    return quick_stop_option >= 5


#: The same, indexed by the low seven bits of the status word (the table's masks use no others).
STATE_OF_STATUS: tuple[DriveState, ...] = tuple(decode_status_word(word) for word in range(128))


def _word(goal: Goal, state: DriveState, quick_stop_option: int) -> int:
    if goal is Goal.ENABLED and state is _S.QUICK_STOP_ACTIVE and not quick_stop_stays(quick_stop_option):
        return CW_QUICK_STOP  # transition 16 is not allowed: let the ramp end, the drive then leaves by itself (12)
    number = ROUTES[goal].get(state)
    if number is not None:
        words = TRANSITIONS[number].words
        return CW_QUICK_STOP if goal is Goal.QUICK_STOP else words[0]
    held, hold_word, safe_word = _HOLD[goal]
    return hold_word if state is held else safe_word


def control_words(quick_stop_option: int) -> tuple[tuple[int, ...], ...]:
    """The planning table [goal][state] -> control word, for a drive with this 0x605A."""
    return tuple(tuple(_word(goal, state, quick_stop_option) for state in DriveState) for goal in Goal)


def reached_states(quick_stop_option: int) -> tuple[tuple[bool, ...], ...]:
    """Table [goal][state] -> whether the drive stands where the goal wants it.

    A quick stop that the drive leaves by itself (0x605A 0 to 4) is reached only when it has left: cutting it short by
    disable voltage would let the axis coast.
    """
    stopped = _AT_OFF | ({_S.QUICK_STOP_ACTIVE} if quick_stop_stays(quick_stop_option) else set())
    wanted = {
        Goal.OFF: _AT_OFF,
        Goal.READY: {_S.READY_TO_SWITCH_ON},
        Goal.ENABLED: {_S.OPERATION_ENABLED},
        Goal.QUICK_STOP: stopped,
    }
    return tuple(tuple(state in wanted[goal] for state in DriveState) for goal in Goal)
