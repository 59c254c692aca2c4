"""Which terms of the last fit are findings, and why the others are none: the levels of the outside contract once more.

Stands between the judgement and the verdict. A term comes in by what it takes when it comes; beside those that come
later it may be worth less, or its numbers may be pushed to an end of their range. It stays in the model then, for the
others were fitted beside it, and is listed with its values as minor.

The contract counts shares of the error on unseen rows. A drift of the constant torque is next to nothing in any row and
adds up in every simulation that runs freely: its share is that of the means over a second, where it shows.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from servod.lab.diagnose.judge.covariance import inside_region
from servod.lab.diagnose.judge.judgement import JudgedSelection
from servod.lab.diagnose.result import MinorReason
from servod.lab.diagnose.select.fit import Fit
from servod.lab.diagnose.select.levels import at_end_of_range, is_level_change, shorter_twin
from servod.lab.diagnose.select.merit import large_enough
from servod.lab.diagnose.select.refine import DRIFT, power_of_means
from servod.lab.diagnose.select.selector import Selector
from servod.lab.diagnose.settings import SETTINGS

Array = NDArray[np.float64]

#: Numbers that say where or when a term acts, whatever its size.
WHERE = frozenset(("shift", "torque_at_middle", "start_s", "position"))

#: Sizes that are positive by themselves, so that only their interval tells them from nothing.
POSITIVE = frozenset(("time_constant_s", "gap"))


def name_findings(selector: Selector, judgement: JudgedSelection) -> JudgedSelection:
    """The judgement with those named that are findings beside all others, and why the rest of the terms is none.

    What each term is worth is said anew. Terms of one effect are one finding, if one of them is.
    """
    fit, selection = judgement.fit, judgement.selection
    for place in judgement.named:
        merit = selector.merit(selection, judgement.validation.reduced[place], fit)
        selection = selection.with_merit(place, merit)
    judgement = replace(judgement, selection=selection)
    why = {place: _reason(judgement, place) for place in judgement.named}
    names = {fit.hypothesis.terms[place].effect for place, reason in why.items() if reason is None}
    named = tuple(place for place in judgement.named if fit.hypothesis.terms[place].effect in names)
    kept = {place: reason for place, reason in why.items() if reason is not None and place not in named}
    return replace(judgement, named=named, kept=kept | _under_level(judgement))


def _under_level(judgement: JudgedSelection) -> dict[int, MinorReason]:
    """Terms with numbers of their own that are under their level; what only opens the model's own is recalibrated."""
    twin = shorter_twin(judgement.fit)
    terms = enumerate(judgement.fit.hypothesis.terms)
    return {
        place: MinorReason.TWIN if term.effect == twin else MinorReason.LEVEL
        for place, term in terms
        if place not in judgement.named and term.unknowns
    }


def _reason(judgement: JudgedSelection, place: int) -> MinorReason | None:
    """Why a term is no finding; None if it is one."""
    fit = judgement.fit
    merit = replace(judgement.selection.merits[place], share=_share(judgement, place))
    if not large_enough(merit, is_level_change(fit.hypothesis.terms[place])):
        return MinorReason.SMALL
    if at_end_of_range(fit, place):
        return MinorReason.AT_END
    return None if differs_from_zero(fit, place, judgement.covariance) else MinorReason.UNSURE


def _share(judgement: JudgedSelection, place: int) -> float:
    """The share of the explainable error on unseen rows that a term takes, where it shows."""
    rows = judgement.removed_share(place)
    if judgement.fit.hypothesis.terms[place].effect != DRIFT[0]:
        return rows
    validation = judgement.validation
    parts = (validation.without[place], validation.after, validation.before)
    without, after, before = (power_of_means(judgement.predictor, held.mismatch) for held in parts)
    return max(rows, (without - after) / max(before, 1e-30))


def differs_from_zero(fit: Fit, place: int, covariance: Array) -> bool:
    """Whether nothing at all lies outside the region of 95 % of what says how large a term is.

    A term whose size has no zero, such as a stiffness or a limit, is told by what it takes alone.
    """
    unknowns, share = fit.hypothesis.unknowns, fit.hypothesis.share(place)
    own = range(share.start, share.stop)
    deviations = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    if any(unknowns[i].key in POSITIVE and SETTINGS.intervals.z95 * deviations[i] >= 1.0 for i in own):
        return False
    sizes = [i for i in own if unknowns[i].size != 0.0 and unknowns[i].low <= 0.0 and unknowns[i].key not in WHERE]
    return not sizes or not inside_region(fit.coordinates[sizes], covariance[np.ix_(sizes, sizes)])
