"""Two terms at once, where neither comes in alone: each hides behind what the other leaves.

A stage of forward selection, where it would end although much is left. A weight behind a torque constant that is off,
or a ripple beside it, leaves so much that one step towards either looks poor, and a fit of either goes elsewhere.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from time import monotonic
from typing import NamedTuple

from servod.lab.diagnose.predict.floor import above_noise
from servod.lab.diagnose.select.candidates import Candidate
from servod.lab.diagnose.select.fit import Fit
from servod.lab.diagnose.select.selection import Selection, TermEntry
from servod.lab.diagnose.select.selector import Selector
from servod.lab.diagnose.settings import SETTINGS

#: First terms beside which a second is searched, and seconds that are fitted to the end beside each.
FIRSTS, SECONDS = 4, 2

#: What two terms that come in together may leave of what is there, at most: physics on nobody's list is no such pair.
MOST_LEFT = 0.1


def add_pair(selector: Selector, selection: Selection, candidates: Sequence[Candidate]) -> Selection:
    """The selection with the first two terms that take nearly all of what is left, each worth it beside the other.

    Where one of them does so without the other, which only led there, it comes in alone.
    """
    if not _much_left(selector, selection):
        return selection
    for first in candidates[:FIRSTS]:
        if monotonic() > selector.deadline:
            break
        begun = selector.settle_candidate(first, selection.fit.mismatch)
        seconds, tried = selector.candidates(begun, skip=frozenset(selection.rejected) | {first.effect})
        selection = replace(selection, tried=selection.tried + tried)
        pair = _pair(selector, selection, begun, seconds)
        if pair is not None:
            return _entered(selector, selection, pair, (first, seconds))
    return selection


class _Pair(NamedTuple):
    """A fit with two terms more, the second of them, and the fits without the first and without the second."""

    fit: Fit
    second: Candidate
    without: tuple[Fit, Fit]


def _pair(selector: Selector, selection: Selection, begun: Fit, seconds: Sequence[Candidate]) -> _Pair | None:
    """The fit with the best second term beside the first that leaves next to nothing; None where none does."""
    left = selector.error(selection.fit.mismatch) - selection.floor
    last = len(begun.hypothesis.terms)
    for second in seconds[:SECONDS]:
        fit = selector.fit_to_end(selector.settle_candidate(second, begun.mismatch))
        if selector.error(fit.mismatch) - selection.floor <= MOST_LEFT * left:
            return _Pair(fit, second, (selector.settle_without(fit, last - 1), selector.settle_without(fit, last)))
    return None


def _entered(
    selector: Selector, selection: Selection, pair: _Pair, tried: tuple[Candidate, Sequence[Candidate]]
) -> Selection:
    """The selection with those of a pair that are worth their place; the rivals of each were tried beside the other."""
    (first, seconds), second = tried, pair.second
    lower = selector.lower_floor(selection, pair.fit.mismatch)
    last = len(pair.fit.hypothesis.terms) - 1
    worth = [selector.merit(selection, without, pair.fit) for without in pair.without]
    enters = [selector.may_enter(selection, worth[i], pair.fit, last - 1 + i) for i in range(2)]
    if not all(enters):
        return _alone(selector, lower, pair.without[0 if enters[1] else 1], second if enters[1] else first)
    firsts, more = selector.candidates(pair.without[0], skip=frozenset(selection.rejected) | {second.effect})
    longer = replace(lower, tried=lower.tried + more).with_term(pair.fit, worth[0], _entry(first, firsts))
    return longer.with_term(pair.fit, worth[1], _entry(second, seconds))


def _alone(selector: Selector, selection: Selection, fit: Fit, term: Candidate) -> Selection:
    """The selection with one of a pair, where it is worth it without the other, which only led there."""
    alone = selector.fit_to_end(fit)
    merit = selector.merit(selection, selection.fit, alone)
    return (
        selection.with_term(alone, merit, _entry(term, ()))
        if selector.may_enter(selection, merit, alone)
        else selection
    )


def _entry(term: Candidate, tried: Sequence[Candidate]) -> TermEntry:
    """How a term came in, with what was tried in its place."""
    left = next((candidate.left for candidate in tried if candidate.effect == term.effect), term.left)
    return TermEntry(left, tuple(candidate for candidate in tried if candidate.effect != term.effect))


def _much_left(selector: Selector, selection: Selection) -> bool:
    """Whether more is left than forms and noise make, of what can be explained and of dry friction."""
    left = selector.error(selection.fit.mismatch) - selection.floor
    explainable = above_noise(selection.base_error, selection.floor)
    much = math.sqrt(max(left, 0.0)) > SETTINGS.group.much_left * selector.predictor.dry
    return much and left > SETTINGS.group.left_share * explainable
