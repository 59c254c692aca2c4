"""Whether a tried set stays: its figures against those of the set before, and against its own promise.

Plain numbers in, sentences out; between the trial and everybody who has to understand its end.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from servod.common.faults import FAULTS, Reaction, faults_in
from servod.formats.gains.gain_set import Promise
from servod.lab.recordings.recording import Rows
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


def rejections(before: Figures | None, after: Figures, promised: Promise, count_rad: float) -> list[str]:
    """Every reason against the set, one sentence each; empty when it stays. `count_rad`: the encoder's resolution.

    Without figures of `before` its promise alone counts.
    """
    return [*(worse(before, after, count_rad) if before else ()), *broken_promises(after, promised, count_rad)]


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


def broken_promises(after: Figures, promised: Promise, count_rad: float) -> Iterator[str]:
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


# --- The cycles of a trial -------------------------------------------------------------------------------------------
# What the cycles of a trial say beside its figures: where motions ran, what was limited, what the loop skipped.


#: A value that is limited in no more than this share of the sines' cycles says nothing against a set: one cycle in a
#: reversal of coarse counts, or as long as an offset fades. What it does to the motion is in the figures.
FEW_LIMITED = 0.002
#: Where the set of before met the limit as well it is low for the motion, and twice as often may be chance; but no more
#: than so much more often, and never more than the most, where that set did not either.
MORE_LIMITED, MOST_LIMITED = 0.01, 0.05
#: Faults that say that a value had to be limited.
_CLIPS = sum(fault.bit for fault in FAULTS.values() if fault.reaction == Reaction.CLIP)


def motions_in(rows: Rows) -> list[Rows]:
    """The stretches of `rows` in which a reference motion ran."""
    edges = np.flatnonzero(np.diff(rows["reference_active"] == 1, prepend=False, append=False))
    return [rows[start:end] for start, end in zip(edges[::2], edges[1::2], strict=True)]


def limits_met(rows: Rows, before: Rows | None) -> list[str]:
    """What had to be limited in these sines, by the table of faults; a step may be limited.

    Not what few cycles met, and not what the set of `before`, where there was one, met about as often: then the limit
    is too low for the motion.
    """
    found = []
    for fault in faults_in(int(np.bitwise_or.reduce(rows["faults"])) & _CLIPS):
        share, earlier = (_share(of, fault.bit) if of is not None else 0.0 for of in (rows, before))
        if share > limited_at_most(earlier):
            found.append(f"{fault.code.name} in {100.0 * share:.2g} % of the cycles: {fault.cause}")
    return found


def _share(rows: Rows, bit: int) -> float:
    """Share of the cycles with this fault's bit."""
    return float(np.mean((rows["faults"] & bit) != 0))


def limited_at_most(earlier: float) -> float:
    """Share of cycles that may be limited where it was `earlier` under the set of before; at least as much as that."""
    return max(FEW_LIMITED, earlier, min(2.0 * earlier, earlier + MORE_LIMITED, MOST_LIMITED))


def doubtful_timing(rows: Rows) -> list[str]:
    """What a loop that does not keep time makes doubtful."""
    missed, cycles = int(rows["missed"][-1] - rows["missed"][0]), int(rows["cycle"][-1] - rows["cycle"][0])
    if not missed:
        return []
    return [
        f"the loop skipped {missed} of {cycles} cycles, and no promise holds then: see `servoctl bench`, and try again"
    ]


def every_cycle(rows: Rows) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(reference, position) at every cycle; cycles that the loop skipped are put between their neighbours."""
    cycle = rows["cycle"] - rows["cycle"][0]
    every = np.arange(int(cycle[-1]) + 1)
    return np.interp(every, cycle, rows["reference_rad"]), np.interp(every, cycle, rows["position_rad"])
