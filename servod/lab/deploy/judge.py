"""Whether a tried set stays: its figures against those of the set before, and against its own promise.

Plain numbers in, sentences out; between the trial and everybody who has to understand its end.
"""

from __future__ import annotations

from collections.abc import Iterator

from servod.formats.gains.gain_set import Promise
from servod.lab.verify.validation import PART_TEXT, Figures, Part

#: Worse than before: above its mean by this share, by so many of its standard errors, and by some encoder counts. The
#: scatter of the new run is not allowed for: a restless set would widen its own limit.
WORSE_SHARE, STANDARD_ERRORS = 0.1, 3.0
#: A joint that sticks far from its reference does not swing, one that still moves to it does: the hold may swing by
#: this share more of the error that the set before left on the slow sine. Of a set that compensates, that is nothing.
STUCK_SHARE = 0.05
#: A broken promise: above the worst promised plant by this share, and by so many encoder counts.
PROMISE_SHARE = 0.3
#: What rounding and noise of the encoder make of an RMS error, and of a swing from peak to peak.
COUNTS = {Part.SLOW: 1.0, Part.BRISK: 1.0, Part.HOLD: 4.0}


def complaints(before: Figures | None, after: Figures, promised: Promise, count_rad: float) -> list[str]:
    """Every reason against the set, one sentence each; empty when it stays. `count_rad`: the encoder's resolution.

    Without figures of `before` its promise alone counts.
    """
    return [*(worse(before, after, count_rad) if before else ()), *broken(after, promised, count_rad)]


def worse(before: Figures, after: Figures, count_rad: float) -> Iterator[str]:
    """Parts of the motion on which the set is worse than the one before, beyond the scatter of the run before."""
    for part in Part:
        limit = worse_limit(before, part, count_rad)
        if after.mean(part) > limit:
            yield (
                f"{PART_TEXT[part]} went from {_mrad(before.mean(part))} to {_mrad(after.mean(part))} mrad; up to "
                f"{_mrad(limit)} would be no worse"
            )


def worse_limit(before: Figures, part: Part, count_rad: float) -> float:
    """Largest mean that is not worse than before [rad]."""
    chance = STANDARD_ERRORS * before.standard_error(part)
    sticks = STUCK_SHARE * before.mean(Part.SLOW) if part is Part.HOLD else 0.0
    return (1.0 + WORSE_SHARE) * before.mean(part) + chance + sticks + COUNTS[part] * count_rad


def broken(after: Figures, promised: Promise, count_rad: float) -> Iterator[str]:
    """Figures beyond what the certificate promised."""
    for part, limit in promise_limits(promised, count_rad).items():
        if after.mean(part) > limit:
            yield (
                f"{PART_TEXT[part]} is {_mrad(after.mean(part))} mrad; the certificate promised "
                f"{_mrad(promised_of(promised, part))}, {_mrad(limit)} with its tolerance: this is not the axis that "
                "the set was designed for"
            )


def promise_limits(promised: Promise, count_rad: float) -> dict[Part, float]:
    """Promise with tolerance, for each part [rad]."""
    return {part: (1.0 + PROMISE_SHARE) * promised_of(promised, part) + COUNTS[part] * count_rad for part in Part}


def promised_of(promised: Promise, part: Part) -> float:
    """The promised figure of one part [rad]."""
    return {Part.SLOW: promised.slow_rad, Part.BRISK: promised.brisk_rad, Part.HOLD: promised.hold_rad}[part]


def promise_document(promised: Promise) -> dict[str, float]:
    """The promised figure of every part in mrad, by the names of the measured ones."""
    return {f"{part.value}_mrad": 1e3 * promised_of(promised, part) for part in Part}


def _mrad(value_rad: float) -> str:
    return f"{1e3 * value_rad:.4g}"
