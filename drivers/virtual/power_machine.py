"""The acting half of the CiA 402 state machine: option codes, quick stop, fault reaction, fault reset by edge.

Between the control word and the drive's torque production. It decides; the drive behind it brakes and cuts the torque.
"""

from __future__ import annotations

from typing import Protocol

from servod.drivers.virtual.power_state import ENERGISED, TRANSITIONS, Command, Ramp, decode_command
from servod.runtime.fieldbus.cia import Obj402
from servod.runtime.fieldbus.devices import DriveState

_S = DriveState
_FAULT_RESET = 0x80
#: 0x605A from here on: the same ramp as 4 less, but quick stop active is kept.
_STAY = 5


class Drive(Protocol):
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

    def __init__(self, drive: Drive) -> None:
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

    def command(self, command: Command, time_ns: int) -> None:
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

    def _command(self, command: Command, time_ns: int) -> None:
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
            if number == 3 and command is Command.ENABLE_OPERATION:
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
