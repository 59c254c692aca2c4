"""Which name the drive's way out of operation gets, where something tells of STO. Beside the axis, which reacts."""

from __future__ import annotations

from servod.common.faults import FAULTS, FaultCode

#: STO makes a drive fault, or leave operation, a few cycles before or after its input and its error code tell of it.
_STO_REPORTED_S = 0.03
_STO = FAULTS[FaultCode.STO_ACTIVE].bit
_BY_STO = FAULTS[FaultCode.DRIVE_FAULT].bit | FAULTS[FaultCode.DRIVE_LEFT_OPERATION].bit


class StoNaming:
    """Which name the drive's way out of operation gets: STO_ACTIVE where STO was it, its own fault otherwise.

    The reaction never waits, only the name does, where something tells of STO at all.
    """

    def __init__(self, period_s: float, known: bool) -> None:
        self._window_cycles = max(1, round(_STO_REPORTED_S / period_s)) if known else 0
        self._left = self._window_cycles
        self._held = 0  # faults that wait for their name
        self._owns = False  # the drive's fault is STO's, until it is left, or stays when STO is over

    @property
    def pending(self) -> bool:
        """A fault waits for its name."""
        return self._held != 0

    @property
    def hidden(self) -> int:
        """Faults that are not to be told now."""
        return _BY_STO if self._owns or self._held else 0

    def named(self, faults: int, in_fault: bool) -> tuple[int, int]:
        """(faults to be told in this cycle, those that a wait has just ended with); `in_fault`: the drive is."""
        if not self._window_cycles:
            return faults, 0
        late = _STO if self._held and faults & _STO else 0
        if faults & _STO:
            self._owns, self._held, self._left = True, 0, self._window_cycles
        elif self._owns:
            self._left -= 1
            self._owns = in_fault and self._left > 0
            if in_fault and not self._owns:  # STO is over and the fault is not: it may be the drive's own
                return faults, late | faults & _BY_STO
        if self._owns:
            return faults & ~_BY_STO, late
        if not (self._held or faults & _BY_STO):
            self._left = self._window_cycles
            return faults, 0
        if self._left < 0:
            return faults, 0
        self._held |= faults & _BY_STO
        self._left -= 1
        if self._left >= 0:
            return faults & ~_BY_STO, 0
        held, self._held = self._held, 0
        return faults | held, held
