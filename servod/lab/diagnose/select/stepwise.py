"""Stepwise selection: terms come in one at a time, the best first, go when others do their work, and change places.

The first stages of the selection, each from one `Selection` to the next: `forward_selection` with
`backward_elimination` behind each term (Efroymson, Multiple regression analysis, 1960), then `swap_terms`.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from time import monotonic

import numpy as np
from numpy.typing import NDArray

from servod.lab.diagnose.effects.hypothesis import Hypothesis
from servod.lab.diagnose.select.candidates import Candidate
from servod.lab.diagnose.select.fit import Fit
from servod.lab.diagnose.select.levels import at_end_of_range, level_at_bound
from servod.lab.diagnose.select.selection import Selection, TermEntry
from servod.lab.diagnose.select.selector import Selector
from servod.lab.diagnose.settings import SETTINGS

Array = NDArray[np.float64]


def forward_selection(selector: Selector, selection: Selection) -> Selection:
    """Add the term that takes most of what is left, again and again, while one deserves it and there is time."""
    while selection.terms < SETTINGS.forward.most_terms and _more_to_find(selector, selection):
        before = selection.terms
        if monotonic() < selector.deadline:
            selection = _add_best(selector, selection)
        if selection.terms == before:
            return replace(selection, cut=monotonic() >= selector.deadline)
        if selection.terms >= 2:
            selection = backward_elimination(selector, selection)
    return selection


def _more_to_find(selector: Selector, selection: Selection) -> bool:
    return not selector.nothing_left(selection) or level_at_bound(selection.fit)


def _add_best(selector: Selector, selection: Selection) -> Selection:
    """Try all effects beside the present fit and take the best if it deserves it.

    A fit behind a gap may improve by being fitted again: what a term is worth counts from there. One that has run to
    the end of its range is none, and sets no bar for the others.
    """
    present = selection.fit
    candidates, tried = selector.candidates(present, skip=frozenset(selection.rejected))
    selection = replace(selection, tried=selection.tried + tried)
    deserves = partial(selector.deserves, selection)
    best = math.inf
    for candidate in candidates:
        if at_end_of_range(candidate.fit, candidate.place):
            continue
        best = min(best, candidate.left)
        if candidate.left > best + SETTINGS.forward.close * (1.0 - best):
            break
        begun = selector.settle_candidate(candidate, present.mismatch)
        fit, merit = selector.fit_on(selection, present, begun, deserves)
        selection = selector.lower_floor(selection, fit.mismatch)
        if selector.may_enter(selection, merit, fit):
            bare = selector.settle_without(fit, len(fit.hypothesis.terms) - 1)
            if selector.error(bare.mismatch) < selector.error(present.mismatch):
                selection, merit = replace(selection, fit=bare), selector.merit(selection, bare, fit)
        if selector.may_enter(selection, merit, fit):
            others = tuple(c for c in candidates if c.effect != candidate.effect)
            return selection.with_term(fit, merit, TermEntry(candidate.left, others))
        if selector.significant(selection, merit, fit) and not at_end_of_range(fit):
            first = selection.minor.get(candidate.effect, merit)
            selection = replace(selection, minor={**selection.minor, candidate.effect: first})
    return selection


def backward_elimination(selector: Selector, selection: Selection) -> Selection:
    """Drop every term but the last whose work the others now do, and say anew what each of those that stay is worth."""
    index = 0
    while index < selection.terms - 1:
        reduced = selector.settle_without(selection.fit, index)
        merit = selector.merit(selection, reduced, selection.fit)
        if selector.deserves(selection, merit, selection.fit, index):
            selection = selection.with_merit(index, merit)
            index += 1
        else:
            selection = selection.without_term(index, reduced)
    return selection


def swap_terms(selector: Selector, selection: Selection) -> Selection:
    """Try rivals in the place of every term but the last, which had them all beside it.

    What was best alone need not be best in company.
    """
    before = selection.fit
    for index in range(selection.terms - 1):
        for rival in _rivals(selection, index):
            if monotonic() > selector.deadline:
                break
            swapped = _swap(selector, selection, index, rival)
            if swapped is not None:
                selection = swapped
                break
    if selection.fit is before:
        return selection
    selection = backward_elimination(selector, selection)
    last = selection.terms - 1
    reduced = selector.settle_without(selection.fit, last)
    return selection.with_merit(last, selector.merit(selection, reduced, selection.fit))


def _swap(selector: Selector, selection: Selection, index: int, rival: Candidate) -> Selection | None:
    """The selection with a rival in the place of a term, if it does better there and deserves to come in."""
    fit = _instead(selector, selection.fit, index, rival)
    if fit is None or not _better(selector, selection.fit, fit):
        return None
    merit = selector.merit(selection, selector.settle_without(fit, index), fit)
    if not selector.may_enter(selection, merit, fit, index):
        return None
    entry = selection.entries[index]
    old = Candidate(selection.fit.hypothesis.terms[index].effect, selection.fit, entry.left, index)
    others = (old, *(c for c in entry.rivals if c.effect != rival.effect))
    entries = (*selection.entries[:index], TermEntry(entry.left, others), *selection.entries[index + 1 :])
    return replace(selection.with_merit(index, merit), fit=fit, entries=entries)


def _rivals(selection: Selection, index: int) -> tuple[Candidate, ...]:
    """Rivals of a term that stood close when it came in and are not in by now."""
    entry = selection.entries[index]
    there = {term.effect for term in selection.fit.hypothesis.terms} | set(selection.rejected)
    most = SETTINGS.swap.within * entry.left
    close = tuple(c for c in entry.rivals if c.left <= most and c.effect not in there)
    return close[: SETTINGS.swap.most_tried]


def _instead(selector: Selector, fit: Fit, index: int, rival: Candidate) -> Fit | None:
    """The fit with a rival's term in the place of its own, started where the rival's fit ended."""
    terms = list(fit.hypothesis.terms)
    terms[index] = rival.term
    hypothesis = replace(fit.hypothesis, terms=tuple(terms))
    at = _coordinates(fit, hypothesis, index, rival)
    try:
        return selector.settle(hypothesis, at, fit.mismatch)
    except ValueError:
        return None


def _coordinates(fit: Fit, hypothesis: Hypothesis, index: int, rival: Candidate) -> Array:
    """Coordinates of the fit, with the rival's own, and with its values of what either of the two opens."""
    own = fit.hypothesis.share(index)
    at = np.concatenate([fit.coordinates[: own.start], rival.own, fit.coordinates[own.stop :]])
    opened = set(fit.hypothesis.terms[index].opens) | set(hypothesis.terms[index].opens)
    for place, unknown in enumerate(hypothesis.base):
        if unknown.key in opened:
            at[place] = rival.fit.coordinates[place]
    return np.asarray(at)


def _better(selector: Selector, old: Fit, new: Fit) -> bool:
    """Whether the new fit costs less, in the scale of the old one."""
    fitter = selector.fitter(old.mismatch)
    was, now = (fitter.cost(fit.hypothesis, fit.coordinates, fit.mismatch) for fit in (old, new))
    better = SETTINGS.swap.better if _size(new) < _size(old) else -SETTINGS.swap.better
    return math.log(max(now, 1e-30) / max(was, 1e-30)) < better


def _size(fit: Fit) -> int:
    return sum(term.numbers for term in fit.hypothesis.terms)
