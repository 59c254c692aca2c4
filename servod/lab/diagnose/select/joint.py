"""Several terms at once: levels of the model's own, friction and mass as a user guessed them, and pairs of effects.

Stages of forward selection. Each alone leaves what the others make, which an effect with many numbers then takes up
better: friction that is twice as viscous and half as dry again was taken for a joint that warms up. They are tried
together in every round, against each effect by itself, and come in as terms of their own.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from time import monotonic
from typing import NamedTuple

from servod.lab.diagnose.effects import effect, effects
from servod.lab.diagnose.effects.hypothesis import Term
from servod.lab.diagnose.effects.search_context import SearchContext
from servod.lab.diagnose.predict.floor import above_noise
from servod.lab.diagnose.select.candidates import Candidate, penalised_left
from servod.lab.diagnose.select.fit import Fit, on_bound
from servod.lab.diagnose.select.levels import is_another
from servod.lab.diagnose.select.merit import Merit, large_enough, worth_naming
from servod.lab.diagnose.select.selection import Selection, TermEntry
from servod.lab.diagnose.select.selector import Selector, is_sound
from servod.lab.diagnose.settings import SETTINGS


def add_levels(selector: Selector, selection: Selection, candidates: Sequence[Candidate]) -> Selection | None:
    """The selection with levels released, where they explain better than any candidate; None where they do not.

    Not where a servo's loop makes the torque: what every servo has comes before friction there.
    """
    present = selection.fit
    fit, merits = _pruned(selector, selection, _released(selector, selection))
    terms = fit.hypothesis.terms[selection.terms :]
    if not terms or not worth_naming(selector.merit(selection, present, fit), level=False):
        return None
    left = _left(selector, present, fit)
    numbers = sum(term.numbers for term in terms)
    if any(_better(rival, left, numbers) for rival in candidates):
        return None
    names = {term.effect for term in terms}
    entry = TermEntry(left, tuple(c for c in candidates if c.effect not in names))
    longer = selector.lower_floor(selection, fit.mismatch)
    for merit in merits:
        longer = longer.with_term(fit, merit, entry)
    return longer


def _released(selector: Selector, selection: Selection) -> Fit:
    """The present fit with every level released that may be, and is not yet.

    One whose bounds a term opens, such as the mass, is where what was released before leaves it on its bound. Beside a
    gain none: nothing would hold their common factor, and half of everything is a bristle of twice the stiffness.
    """
    fit = selection.fit
    scene = SearchContext(selector.start.document, selector.predictor, fit.mismatch)
    out = {term.effect for term in fit.hypothesis.terms} | set(selection.rejected) | selector.untried
    if scene.servo or any(effect(term.effect).scales_torques for term in fit.hypothesis.terms):
        return fit
    terms = [what.terms(scene)[:1] for what in effects() if what.jointly and what.name not in out]
    for term in sorted((term for first in terms for term in first), key=lambda term: bool(term.opens)):
        bounded = {unknown.key for unknown, on in zip(fit.hypothesis.base, on_bound(fit), strict=False) if on}
        fit = fit if term.opens and bounded.isdisjoint(term.opens) else _with(selector, fit, term)
    return selector.fit_to_end(fit)


def _with(selector: Selector, fit: Fit, term: Term) -> Fit:
    hypothesis = fit.hypothesis.with_term(term)
    return selector.settle(hypothesis, hypothesis.beside(fit.coordinates), fit.mismatch, fit.jacobian)


def _pruned(selector: Selector, selection: Selection, fit: Fit) -> tuple[Fit, list[Merit]]:
    """The fit without those of the new terms that do nothing of a size beside the others, and what the rest is worth.

    How much of what is left one of them takes is not asked: all of them together must take enough.
    """
    index, merits = selection.terms, list[Merit]()
    while index < len(fit.hypothesis.terms):
        reduced = selector.settle_without(fit, index)
        merit = selector.merit(selection, reduced, fit)
        worth = large_enough(merit, level=False) and selector.significant(selection, merit, fit, index)
        if worth and is_sound(merit, fit, index):
            merits.append(merit)
            index += 1
        else:
            fit, index, merits = reduced, selection.terms, []
    return fit, merits


def _left(selector: Selector, old: Fit, new: Fit) -> float:
    """What is left of the cost of the old fit, as a share of it."""
    fitter = selector.fitter(old.mismatch)
    was, now = (fitter.cost(fit.hypothesis, fit.coordinates, fit.mismatch) for fit in (old, new))
    return now / max(was, 1e-30)


def _better(rival: Candidate, left: float, numbers: int) -> bool:
    """Whether a candidate explains better than levels that leave so much with so many numbers.

    Where levels leave next to nothing one with as many numbers must leave clearly less, and one with fewer no more: the
    plain cause comes first, one factor on all torques before mass and friction that are off by the same.
    """
    if is_another(rival.fit, rival.term_index):
        return False
    if left <= SETTINGS.joint.nearly_all:
        if rival.term.numbers < numbers:
            return rival.left <= SETTINGS.joint.as_good * left + SETTINGS.joint.nothing
        return left > SETTINGS.joint.as_good * rival.left + SETTINGS.joint.nothing
    return penalised_left(rival) <= left * (1.0 + SETTINGS.trials.per_number * numbers)


# --- Two effects -----------------------------------------------------------------------------------------------------
# Two terms at once, where neither comes in alone: each hides behind what the other leaves. Tried where forward
# selection would end although much is left: a ripple beside a torque constant that is off leaves so much that one step
# towards either looks poor, and a fit of either goes elsewhere.


#: First terms beside which a second is searched, each of which takes as long as a plain diagnosis, and seconds that are
#: fitted to the end beside each.
FIRSTS, SECONDS = 2, 2

#: What two terms that come in together may leave of what is there, at most: physics on nobody's list is no such pair.
MOST_LEFT = 0.1


def add_pair(selector: Selector, selection: Selection, candidates: Sequence[Candidate]) -> Selection:
    """The selection with the first two terms that take nearly all of what is left, each worth it beside the other.

    Where one of them does so without the other, which only led there, it comes in alone.
    """
    if selection.terms + 2 > SETTINGS.forward.most_terms or not much_left(selector, selection):
        return selection
    for first in candidates[:FIRSTS]:
        if monotonic() > selector.deadline:
            break
        begun = selector.settle_candidate(first, selection.fit.mismatch)
        seconds, tried = selector.candidates(begun, skip=frozenset(selection.rejected) | {first.effect})
        selection = replace(selection, tried=selection.tried + tried)
        if monotonic() > selector.deadline:
            break
        pair = _pair(selector, selection, begun, seconds)
        longer = selection if pair is None else _entered(selector, selection, pair, (first, seconds))
        if longer.terms > selection.terms:
            return longer
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


def much_left(selector: Selector, selection: Selection) -> bool:
    """Whether more is left than forms and noise make, of what can be explained and of dry friction."""
    left = selector.error(selection.fit.mismatch) - selection.floor
    explainable = above_noise(selection.base_error, selection.floor)
    much = math.sqrt(max(left, 0.0)) > SETTINGS.group.much_left * selector.predictor.dry
    return much and left > SETTINGS.group.left_share * explainable
