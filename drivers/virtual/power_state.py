"""The CiA 402 power drive system as data: commands, transitions, status words.

Used by the amplifier's power machine. One row for each transition, with its number in the standard.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Protocol

from servod.runtime.fieldbus import cia
from servod.runtime.fieldbus.cia import Obj402
from servod.runtime.fieldbus.devices import DriveState
from servod.runtime.fieldbus.devices import DriveState as S


class DriveCommand(IntEnum):
    """What a control word asks for (bits 0 to 3; the fault reset is an edge and stands apart)."""

    DISABLE_VOLTAGE = 0
    QUICK_STOP = 1
    SHUTDOWN = 2
    SWITCH_ON = 3  # in operation enabled: disable operation
    ENABLE_OPERATION = 4


_C = DriveCommand

#: (state, command) -> (number of the transition, new state). What is not here is refused: the state stays.
TRANSITIONS: dict[tuple[S, DriveCommand], tuple[int, S]] = {
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


def decode_command(control_word: int) -> DriveCommand:
    """The command in bits 0 to 3 of a control word; every word is exactly one."""
    if not control_word & 0x2:
        return DriveCommand.DISABLE_VOLTAGE
    if not control_word & 0x4:
        return DriveCommand.QUICK_STOP
    if not control_word & 0x1:
        return DriveCommand.SHUTDOWN
    return DriveCommand.ENABLE_OPERATION if control_word & 0x8 else DriveCommand.SWITCH_ON


# --- The status word -------------------------------------------------------------------------------------------------
# The status word 0x6041, put together from everything that it tells.


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


# --- The state machine -----------------------------------------------------------------------------------------------
# The acting half of the CiA 402 state machine: option codes, quick stop, fault reaction, fault reset by edge. Between
# the control word and the drive's torque production. It decides; the drive behind it brakes and cuts the torque.


_S = DriveState
_FAULT_RESET = 0x80
#: 0x605A from here on: the same ramp as 4 less, but quick stop active is kept.
_STAY = 5


class PowerStage(Protocol):
    """What the machine asks of the drive."""

    def option(self, obj: Obj402) -> int:
        """Present value of an option code."""

    def has_power(self) -> bool:
        """True when the supply is there and nothing inhibits the power stage."""

    def cause_gone(self) -> bool:
        """True when no cause of a fault is present any more."""

    def ignores(self, state: DriveState, transition: int) -> bool:
        """True when control words do not cause this transition from this state: a drive that does not obey."""

    def brake(self, ramp: Ramp, time_ns: int) -> None:
        """Begin to stop; the drive calls `PowerMachine.stopped` when at rest, and holds until told otherwise."""

    def energise(self, time_ns: int) -> None:
        """Follow the target values from now on."""

    def cut(self, time_ns: int) -> None:
        """No torque from now on."""

    def fault_cleared(self, time_ns: int) -> None:
        """The fault was acknowledged."""


class PowerMachine:
    """State of the power drive system; `state` is read for the status word."""

    def __init__(self, drive: PowerStage) -> None:
        self._drive = drive
        self.state = _S.NOT_READY_TO_SWITCH_ON
        self.last_transition = 0
        self._control_word = 0
        self._after_stop: DriveState | None = None  # of disable operation and shutdown by ramp

    def start(self, time_ns: int) -> None:
        """Transitions 0 and 1: power on and self-test."""
        self._after_stop = None
        self._control_word = 0
        self._drive.cut(time_ns)
        self._go(1, _S.SWITCH_ON_DISABLED)

    def control(self, word: int, time_ns: int) -> None:
        """Judge a control word; called at every one that is received, changed or not."""
        edge = word & _FAULT_RESET & ~self._control_word
        self._control_word = word
        if self.state is _S.FAULT:
            if edge and self._drive.cause_gone() and not self._drive.ignores(self.state, 15):
                self._go(15, _S.SWITCH_ON_DISABLED)
                self._drive.fault_cleared(time_ns)
        elif self.state is not _S.FAULT_REACTION_ACTIVE:
            command = decode_command(word)
            number, _ = TRANSITIONS.get((self.state, command), (0, self.state))
            if not self._drive.ignores(self.state, number):
                self._command(command, time_ns)

    def command(self, command: DriveCommand, time_ns: int) -> None:
        """A command from inside the drive (abort of the connection)."""
        if self.state not in (_S.FAULT, _S.FAULT_REACTION_ACTIVE):
            self._command(command, time_ns)

    def fault(self, time_ns: int, brake: bool) -> None:
        """Transition 13, and 14 when the reaction (0x605E) is done. `brake` False: the power stage is unusable."""
        if self.state in (_S.FAULT, _S.FAULT_REACTION_ACTIVE):
            if not brake and self.state is _S.FAULT_REACTION_ACTIVE:
                self._disable(14, _S.FAULT, time_ns)
            return
        option = self._drive.option(Obj402.FAULT_REACTION_OPTION)
        brakes = brake and option != Ramp.DISABLE and self.state in ENERGISED
        self._after_stop = None
        self._go(13, _S.FAULT_REACTION_ACTIVE)
        if brakes:
            self._drive.brake(Ramp(option), time_ns)
        else:
            self._disable(14, _S.FAULT, time_ns)

    def stopped(self, time_ns: int) -> None:
        """The drive is at rest after `brake`."""
        if self.state is _S.FAULT_REACTION_ACTIVE:
            self._disable(14, _S.FAULT, time_ns)
        elif self.state is _S.QUICK_STOP_ACTIVE:
            if self._drive.option(Obj402.QUICK_STOP_OPTION) < _STAY:
                self._disable(12, _S.SWITCH_ON_DISABLED, time_ns)
        elif self._after_stop is not None:
            target, self._after_stop = self._after_stop, None
            self._disable(5 if target is _S.SWITCHED_ON else 8, target, time_ns)

    def _command(self, command: DriveCommand, time_ns: int) -> None:
        row = TRANSITIONS.get((self.state, command))
        if row is None:
            return
        number, target = row
        if number == 2 and not self._drive.has_power():
            return
        if number == 11:
            self._quick_stop(time_ns)
        elif number in (5, 8):
            self._leave_operation(number, target, time_ns)
        elif number in (4, 16):
            self._enable(number, time_ns)
        elif number in (9, 12):
            self._disable(number, target, time_ns)
        else:
            self._go(number, target)
            if number == 3 and command is DriveCommand.ENABLE_OPERATION:
                self._enable(4, time_ns)

    def _enable(self, number: int, time_ns: int) -> None:
        if number == 16 and self._drive.option(Obj402.QUICK_STOP_OPTION) < _STAY:
            return
        self._go(number, _S.OPERATION_ENABLED)
        self._drive.energise(time_ns)

    def _quick_stop(self, time_ns: int) -> None:
        option = self._drive.option(Obj402.QUICK_STOP_OPTION)
        self._after_stop = None
        self._go(11, _S.QUICK_STOP_ACTIVE)
        if option == Ramp.DISABLE:
            self._disable(12, _S.SWITCH_ON_DISABLED, time_ns)
        else:
            self._drive.brake(Ramp(option - 4 if option >= _STAY else option), time_ns)

    def _leave_operation(self, number: int, target: DriveState, time_ns: int) -> None:
        """Transitions 5 and 8, after the ramp when the option code asks for one."""
        option = Obj402.DISABLE_OPTION if number == 5 else Obj402.SHUTDOWN_OPTION
        if self._after_stop is not None:
            self._after_stop = target
        elif self._drive.option(option) == Ramp.SLOW_DOWN:
            self._after_stop = target
            self._drive.brake(Ramp.SLOW_DOWN, time_ns)
        else:
            self._disable(number, target, time_ns)

    def _disable(self, number: int, target: DriveState, time_ns: int) -> None:
        self._after_stop = None
        self._drive.cut(time_ns)
        self._go(number, target)

    def _go(self, number: int, target: DriveState) -> None:
        self.last_transition = number
        self.state = target
