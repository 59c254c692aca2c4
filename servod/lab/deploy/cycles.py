"""What the cycles of a trial say beside its figures: where motions ran, what was limited, what the loop skipped.

Between a link's rows and the verdict.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from servod.client.links import Rows
from servod.common.errors import FAULTS, Reaction, faults_in

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


def skipped(rows: Rows) -> list[str]:
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
