"""Several numbers of the model's own at once: friction as a user guessed it, and the mass beside.

A stage of forward selection. Each alone leaves what the others make, which an effect with many numbers then takes up
better: friction that is twice as viscous and half as dry again was taken for a joint that warms up. They are tried
together in every round, against each effect by itself, and come in as terms of their own.
"""

from __future__ import annotations

from collections.abc import Sequence

from servod.lab.diagnose.effects import effects
from servod.lab.diagnose.effects.hypothesis import Term
from servod.lab.diagnose.effects.search_context import SearchContext
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

    One whose bounds a term opens, such as the mass, is where what was released before leaves it on its bound.
    """
    fit = selection.fit
    scene = SearchContext(selector.start.document, selector.predictor, fit.mismatch)
    out = {term.effect for term in fit.hypothesis.terms} | set(selection.rejected) | selector.untried
    if scene.servo:
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
    place, merits = selection.terms, list[Merit]()
    while place < len(fit.hypothesis.terms):
        reduced = selector.settle_without(fit, place)
        merit = selector.merit(selection, reduced, fit)
        worth = large_enough(merit, level=False) and selector.significant(selection, merit, fit, place)
        if worth and is_sound(merit, fit, place):
            merits.append(merit)
            place += 1
        else:
            fit, place, merits = reduced, selection.terms, []
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
    if is_another(rival.fit, rival.place):
        return False
    if left <= SETTINGS.joint.nearly_all:
        if rival.term.numbers < numbers:
            return rival.left <= SETTINGS.joint.as_good * left + SETTINGS.joint.nothing
        return left > SETTINGS.joint.as_good * rival.left + SETTINGS.joint.nothing
    return penalised_left(rival) <= left * (1.0 + SETTINGS.trials.per_number * numbers)
