"""How a motion is judged: the bounds that all judges share, and the figures of one motion cycle by cycle.

Below the laboratory, which judges whole series by the same bounds (servod.lab.tracking.metrics), and the command line,
which has no numpy beside the axis.
"""

from __future__ import annotations

import math
from array import array
from typing import Any, NamedTuple

#: The error is scored without its first second, in which the axis starts to move.
SETTLE_S = 1.0
#: A motion has settled when its error stays below this share of its travel ...
BAND_SHARE = 0.02
#: ... or below this many encoder counts, where that is more: below it the encoder tells nothing.
BAND_COUNTS = 3.0


def settling_band(travel: float, count: float) -> float:
    """Largest error of what has settled, in the unit of `travel`; `count` is the encoder's resolution (0: none)."""
    return max(BAND_SHARE * abs(travel), BAND_COUNTS * count)


class MotionCycle(NamedTuple):
    """What a tally wants of one cycle: time in s, whether a motion runs, positions in rad, torque in N*m, and the
    counter of missed periods."""

    time_s: float
    active: bool
    reference_rad: float
    position_rad: float
    torque_nm: float
    missed: int


class MotionFigures(NamedTuple):
    """How one motion went: errors are the encoder's against the reference.

    RMS and largest error are those from `judged_from_s` after the begin of the motion on. `settling_s` counts from
    where the reference came to rest, until the error stays within `band_mrad`; None where it did not within the
    `watched_s` that were looked at. `peak_torque_nm` is commanded, after the limits.
    """

    rms_error_mrad: float
    max_error_mrad: float
    judged_from_s: float
    settling_s: float | None
    band_mrad: float
    watched_s: float
    peak_torque_nm: float
    missed_cycles: int
    cycles: int

    def document(self) -> dict[str, Any]:
        """Plain values, as JSON has them."""
        return self._asdict()


class _Errors:
    """RMS and peak of a series that nobody keeps."""

    def __init__(self) -> None:
        self.count, self.squares, self.peak = 0, 0.0, 0.0

    def add(self, error: float) -> None:
        """One more."""
        self.count += 1
        self.squares += error * error
        self.peak = max(self.peak, abs(error))

    @property
    def rms(self) -> float:
        """Of all; 0 without any."""
        return math.sqrt(self.squares / self.count) if self.count else 0.0


class MotionTally:
    """Adds up the figures of one motion as its cycles come; it keeps of them what was held last alone.

    The first cycle is from before the motion. A motion runs from the first cycle that says so, or whose reference is
    another one, to the last such cycle; what comes then is looked at for settling.
    """

    def __init__(self, count_rad: float) -> None:
        """`count_rad` is the encoder's resolution (0: none)."""
        self._count_rad = count_rad
        self._before: MotionCycle | None = None
        self._begin_s: float | None = None
        self._lowest = self._highest = math.nan
        self._late, self._all = _Errors(), _Errors()
        self._held_s, self._held_errors = array("d"), array("d")
        self._peak_nm, self._missed_before, self._missed, self._cycles = 0.0, 0, 0, 0

    @property
    def at_rest_s(self) -> float:
        """For how long the reference has stood still."""
        return self._held_s[-1] - self._held_s[0] if self._held_s else 0.0

    def add(self, cycle: MotionCycle) -> None:
        """Take the next cycle."""
        before, self._before = self._before, cycle
        if before is None:
            self._missed_before = cycle.missed
            return
        moves = cycle.reference_rad != before.reference_rad
        if self._begin_s is None:
            if not (moves or cycle.active):
                self._missed_before = cycle.missed
                return
            self._begin_s = cycle.time_s
            self._lowest = self._highest = before.reference_rad
        if moves:
            del self._held_s[:], self._held_errors[:]
            self._lowest = min(self._lowest, cycle.reference_rad)
            self._highest = max(self._highest, cycle.reference_rad)
        error = cycle.reference_rad - cycle.position_rad
        self._held_s.append(cycle.time_s)
        self._held_errors.append(error)
        if moves or cycle.active:
            self._in_motion(cycle, cycle.time_s - self._begin_s, error)

    def _in_motion(self, cycle: MotionCycle, time_s: float, error: float) -> None:
        self._cycles += 1
        self._missed = cycle.missed - self._missed_before
        self._peak_nm = max(self._peak_nm, abs(cycle.torque_nm))
        if math.isfinite(error):
            self._all.add(error)
            if time_s >= SETTLE_S:
                self._late.add(error)

    def figures(self) -> MotionFigures | None:
        """The figures so far; None when no motion was seen. A motion that ends within SETTLE_S is judged whole."""
        if self._begin_s is None or not self._all.count:
            return None
        errors = self._late if self._late.count else self._all
        band_rad = settling_band(self._highest - self._lowest, self._count_rad)
        return MotionFigures(
            rms_error_mrad=1e3 * errors.rms,
            max_error_mrad=1e3 * errors.peak,
            judged_from_s=SETTLE_S if self._late.count else 0.0,
            settling_s=self._settling_s(band_rad),
            band_mrad=1e3 * band_rad,
            watched_s=self.at_rest_s,
            peak_torque_nm=self._peak_nm,
            missed_cycles=self._missed,
            cycles=self._cycles,
        )

    def _settling_s(self, band_rad: float) -> float | None:
        """As servod.lab.tracking.metrics.settling has it; an error that is not finite is outside."""
        first = len(self._held_errors)
        while first and abs(self._held_errors[first - 1]) <= band_rad:
            first -= 1
        return self._held_s[first] - self._held_s[0] if first < len(self._held_s) else None
