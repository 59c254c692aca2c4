"""The CiA 402 power drive system as data: commands, transitions, status words.

Used by the amplifier's power machine. One row for each transition, with its number in the standard.
"""

from __future__ import annotations

from enum import IntEnum

from servod.runtime.fieldbus import cia
from servod.runtime.fieldbus.devices import DriveState
from servod.runtime.fieldbus.devices import DriveState as S


class Command(IntEnum):
    """What a control word asks for (bits 0 to 3; the fault reset is an edge and stands apart)."""

    DISABLE_VOLTAGE = 0
    QUICK_STOP = 1
    SHUTDOWN = 2
    SWITCH_ON = 3  # in operation enabled: disable operation
    ENABLE_OPERATION = 4


_C = Command

#: (state, command) -> (number of the transition, new state). What is not here is refused: the state stays.
TRANSITIONS: dict[tuple[S, Command], tuple[int, S]] = {
    (S.SWITCH_ON_DISABLED, _C.SHUTDOWN): (2, S.READY_TO_SWITCH_ON),
    (S.READY_TO_SWITCH_ON, _C.SWITCH_ON): (3, S.SWITCHED_ON),
    (S.READY_TO_SWITCH_ON, _C.ENABLE_OPERATION): (3, S.SWITCHED_ON),  # and 4 follows by itself
    (S.SWITCHED_ON, _C.ENABLE_OPERATION): (4, S.OPERATION_ENABLED),
    (S.OPERATION_ENABLED, _C.SWITCH_ON): (5, S.SWITCHED_ON),
    (S.SWITCHED_ON, _C.SHUTDOWN): (6, S.READY_TO_SWITCH_ON),
    (S.READY_TO_SWITCH_ON, _C.DISABLE_VOLTAGE): (7, S.SWITCH_ON_DISABLED),
    (S.READY_TO_SWITCH_ON, _C.QUICK_STOP): (7, S.SWITCH_ON_DISABLED),
    (S.OPERATION_ENABLED, _C.SHUTDOWN): (8, S.READY_TO_SWITCH_ON),
    (S.OPERATION_ENABLED, _C.DISABLE_VOLTAGE): (9, S.SWITCH_ON_DISABLED),
    (S.SWITCHED_ON, _C.DISABLE_VOLTAGE): (10, S.SWITCH_ON_DISABLED),
    (S.SWITCHED_ON, _C.QUICK_STOP): (10, S.SWITCH_ON_DISABLED),
    (S.OPERATION_ENABLED, _C.QUICK_STOP): (11, S.QUICK_STOP_ACTIVE),
    (S.QUICK_STOP_ACTIVE, _C.DISABLE_VOLTAGE): (12, S.SWITCH_ON_DISABLED),
    (S.QUICK_STOP_ACTIVE, _C.ENABLE_OPERATION): (16, S.OPERATION_ENABLED),  # only when 0x605A is 5 to 8
}

#: Bits 0 to 3, 5 and 6 of the status word.
STATUS_BITS: dict[S, int] = {
    S.NOT_READY_TO_SWITCH_ON: 0x00,
    S.SWITCH_ON_DISABLED: 0x40,
    S.READY_TO_SWITCH_ON: 0x21,
    S.SWITCHED_ON: 0x23,
    S.OPERATION_ENABLED: 0x27,
    S.QUICK_STOP_ACTIVE: 0x07,
    S.FAULT_REACTION_ACTIVE: 0x0F,
    S.FAULT: 0x08,
}

#: States in which the power stage produces torque.
ENERGISED = (S.OPERATION_ENABLED, S.QUICK_STOP_ACTIVE, S.FAULT_REACTION_ACTIVE)


class Ramp(IntEnum):
    """How the drive brings the axis to rest; the numbers are those of 0x605A, 0x605D and 0x605E."""

    DISABLE = 0
    SLOW_DOWN = 1  # 0x6084
    QUICK_STOP = 2  # 0x6085
    CURRENT_LIMIT = 3
    VOLTAGE_LIMIT = 4


def decode_command(control_word: int) -> Command:
    """The command in bits 0 to 3 of a control word; every word is exactly one."""
    if not control_word & 0x2:
        return Command.DISABLE_VOLTAGE
    if not control_word & 0x4:
        return Command.QUICK_STOP
    if not control_word & 0x1:
        return Command.SHUTDOWN
    return Command.ENABLE_OPERATION if control_word & 0x8 else Command.SWITCH_ON


# The status word 0x6041, put together from everything that it tells.
#
# Used by the amplifier at each refresh.


_FOLLOWING_ERROR = 1 << 13


def status_word(
    state: DriveState,
    *,
    supplied: bool,
    local: bool,
    warning: bool,
    limited: bool,
    reached: bool,
    follows: bool,
    following_error: bool,
) -> int:
    """The word; `follows` is bit 12 of the cyclic modes (set-point acknowledge in profile position)."""
    word = STATUS_BITS[state]
    if supplied:
        word |= cia.SW_VOLTAGE_ENABLED
    if state in (DriveState.SWITCH_ON_DISABLED, DriveState.FAULT):
        word |= cia.SW_QUICK_STOP  # no quick stop is active: the bit is active low
    if not local:
        word |= cia.SW_REMOTE
    if warning:
        word |= cia.SW_WARNING
    if limited:
        word |= cia.SW_INTERNAL_LIMIT
    if reached:
        word |= cia.SW_TARGET_REACHED
    if follows:
        word |= cia.SW_FOLLOWS_COMMAND
    if following_error:
        word |= _FOLLOWING_ERROR
    return word
