"""Other forms of what is in: the form that was best when a term came in need not be the best beside the others.

A stage behind the swaps. Of two curves over temperature the wrong one wins while a delay is still missing; a form with
more numbers, a spring that stiffens, gets further where the fit of the plain one ended early.
"""

from __future__ import annotations

from dataclasses import replace
from time import monotonic

import numpy as np
from numpy.typing import NDArray

from servod.lab.diagnose.effects import effect
from servod.lab.diagnose.effects.hypothesis import Hypothesis, Term
from servod.lab.diagnose.effects.search_context import SearchContext
from servod.lab.diagnose.select.fit import Fit
from servod.lab.diagnose.select.selection import Selection
from servod.lab.diagnose.select.selector import Selector
from servod.lab.diagnose.select.stepwise import judged_again, settled
from servod.lab.diagnose.settings import SETTINGS

Array = NDArray[np.float64]

#: Another form takes the place of the present one where it costs less than this share of it, every number counted; a
#: plainer one where it costs no more: a spring that stiffens by nothing is a spring.
CHEAPER = 0.99

#: To how many other forms in turn a term may go: to one that gets further, and from there to a plainer one.
TURNS = 3


def better_forms(selector: Selector, selection: Selection) -> Selection:
    """The selection with every term in that of its forms which explains most beside the others."""
    before = selection.fit
    for index in range(selection.terms):
        for _ in range(TURNS):
            found = _better_form(selector, selection, index)
            if found is selection:
                break
            selection = found
    if selection.fit is before:
        return selection
    return judged_again(selector, selector.lower_floor(selection, selection.fit.mismatch))


def _better_form(selector: Selector, selection: Selection, index: int) -> Selection:
    """The selection with one of its terms in the best of its other forms, or as it is."""
    for fit in _other_forms(selector, selection, index):
        limit = 1.0 if _numbers(fit) < _numbers(selection.fit) else CHEAPER
        if _cost(selector, selection.fit, fit) < limit * _cost(selector, selection.fit, selection.fit):
            merit = selector.merit(selection, selector.settle_without(fit, index), fit)
            if selector.may_enter(selection, merit, fit, index):
                selection = replace(selection.with_merit(index, merit), fit=fit)
    return selection


def _cost(selector: Selector, present: Fit, fit: Fit) -> float:
    """Cost of a fit in the scale of the present one, a little more for every number."""
    fitter = selector.fitter(present.mismatch)
    cost = fitter.cost(fit.hypothesis, fit.coordinates, fit.mismatch)
    return cost * (1.0 + SETTINGS.trials.per_number * _numbers(fit))


def _numbers(fit: Fit) -> int:
    return sum(term.numbers for term in fit.hypothesis.terms)


def _other_forms(selector: Selector, selection: Selection, term_index: int) -> list[Fit]:
    """The fit with each other form of one of its terms, fitted to its end; the fewest numbers first."""
    present = selection.fit
    own, found = present.hypothesis.terms[term_index], list[Fit]()
    kept = np.delete(present.coordinates, present.hypothesis.share(term_index))
    without = selector.fitter(present.mismatch).mismatch(present.hypothesis.without(term_index), kept)
    if without is None:
        return found
    document = present.hypothesis.without(term_index).written(kept)
    scene = SearchContext(selector.start.document, selector.predictor, without, present=document)
    forms = {term.form: term for term in reversed(effect(own.effect).terms(scene)) if term.each is None}
    for term in sorted(forms.values(), key=lambda term: term.numbers):
        if term.form == own.form or monotonic() > selector.deadline:
            continue
        terms = tuple(term if index == term_index else other for index, other in enumerate(present.hypothesis.terms))
        hypothesis = replace(present.hypothesis, terms=terms)
        starts = _starts(present, hypothesis, term_index, far=effect(own.effect).far)
        fits = [fit for at in starts if (fit := settled(selector, hypothesis, at, present.mismatch)) is not None]
        found += sorted(fits, key=lambda fit: _cost(selector, present, fit))[:1]
    return found


def _starts(present: Fit, hypothesis: Hypothesis, index: int, far: bool) -> list[Array]:
    """Coordinates with those numbers of the other form as they are that it shares with the present one.

    Where the present form has borrowed from the model's own parameters, those stand far away: they begin at the nominal
    model as well.
    """
    old = present.hypothesis.share(index)
    own = _carried(present.hypothesis.terms[index], hypothesis.terms[index], present.coordinates[old])
    at = np.concatenate([present.coordinates[: old.start], own, present.coordinates[old.stop :]])
    nominal = at.copy()
    nominal[: len(hypothesis.base)] = hypothesis.start[: len(hypothesis.base)]
    return [at, nominal] if far else [at]


def _carried(old: Term, new: Term, coordinates: Array) -> Array:
    """Coordinates of a form's own unknowns: what the old form knows of them, or their starts."""
    known = {unknown.key: unknown.value(float(at)) for unknown, at in zip(old.unknowns, coordinates, strict=True)}
    return np.array([unknown.coordinate(known.get(unknown.key, unknown.start)) for unknown in new.unknowns])
