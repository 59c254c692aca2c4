"""Stepwise selection: terms come in one at a time, the best first, go when others do their work, and change places.

The stages of the selection, each from one `Selection` to the next: `forward_selection` with `backward_elimination`
behind each term (Efroymson, Multiple regression analysis, 1960), then `swap_terms`; and what real machines need beyond.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import partial
from time import monotonic

import numpy as np
from numpy.typing import NDArray

from servod.lab.diagnose.effects import effect, names
from servod.lab.diagnose.effects.hypothesis import Hypothesis
from servod.lab.diagnose.effects.search_context import SearchContext
from servod.lab.diagnose.predict.predict import Predictor
from servod.lab.diagnose.select.candidates import Candidate
from servod.lab.diagnose.select.cross_validation import make_folds, predict_held_out
from servod.lab.diagnose.select.fit import Fit
from servod.lab.diagnose.select.free_windows import free_run_errors
from servod.lab.diagnose.select.joint import add_levels, add_pair, much_left
from servod.lab.diagnose.select.levels import is_another, level_at_bound, releases_level
from servod.lab.diagnose.select.merit import Merit
from servod.lab.diagnose.select.selection import Selection, TermEntry
from servod.lab.diagnose.select.selector import Selector, is_sound
from servod.lab.diagnose.settings import SETTINGS

Array = NDArray[np.float64]


def forward_selection(selector: Selector, selection: Selection) -> Selection:
    """Add the term that takes most of what is left, again and again, while one deserves it and there is time.

    Where two terms drive each other out in turns, the same ones stand there a second time: that is the end.
    """
    seen = {_forms(selection)}
    while selection.terms < SETTINGS.forward.most_terms and _more_to_find(selector, selection):
        before = selection.terms
        if monotonic() < selector.deadline:
            selection = _add_best(selector, selection)
        if selection.terms == before:
            return replace(selection, cut=monotonic() >= selector.deadline)
        if selection.terms >= 2:
            selection = backward_elimination(selector, selection)
        if _forms(selection) in seen:
            return selection
        seen.add(_forms(selection))
    return selection


def _forms(selection: Selection) -> tuple[tuple[str, str], ...]:
    """The terms that are in, whatever order they came in."""
    return tuple(sorted((term.effect, term.form) for term in selection.fit.hypothesis.terms))


def _more_to_find(selector: Selector, selection: Selection) -> bool:
    return not selector.nothing_left(selection) or level_at_bound(selection.fit)


def _add_best(selector: Selector, selection: Selection) -> Selection:
    """Try all effects beside the present fit and take the best if it deserves it, or two that only together do.

    A fit behind a gap may improve by being fitted again: what a term is worth counts from there.
    """
    present = selection.fit
    candidates, tried = selector.candidates(present, skip=frozenset(selection.rejected))
    selection = replace(selection, tried=selection.tried + tried)
    if (longer := add_levels(selector, selection, candidates)) is not None:
        return longer
    deserves = partial(selector.deserves, selection)
    for candidate in worth_trying(present, candidates):
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
        if selector.significant(selection, merit, fit) and not is_another(fit):
            first = selection.minor.get(candidate.effect, merit)
            selection = replace(selection, minor={**selection.minor, candidate.effect: first})
    return add_pair(selector, selection, candidates)


def worth_trying(present: Fit, candidates: Iterable[Candidate]) -> Iterator[Candidate]:
    """Candidates that take nearly what the best takes, and any that releases a level which the data pull on its bound.

    One that has run to the end of its range is none, and sets no bar for the others.
    """
    best, close = math.inf, True
    for candidate in candidates:
        if is_another(candidate.fit, candidate.term_index):
            continue
        best = min(best, candidate.left)
        close = close and candidate.left <= best + SETTINGS.forward.close * (1.0 - best)
        if close or releases_level(present, candidate.term):
            yield candidate


def backward_elimination(selector: Selector, selection: Selection) -> Selection:
    """Drop every term but the last whose work the others now do, the one that is missed least first, and say again what
    each of those that stay is worth.

    The first of them in order of coming in may be the right one, whose work a wrong one does badly.
    """
    while True:
        reduced = [selector.settle_without(selection.fit, index) for index in range(selection.terms - 1)]
        merits = [selector.merit(selection, fit, selection.fit) for fit in reduced]
        idle = [i for i, merit in enumerate(merits) if not selector.deserves(selection, merit, selection.fit, i)]
        if not idle:
            for index, merit in enumerate(merits):
                selection = selection.with_merit(index, merit)
            return selection
        least = min(idle, key=lambda index: selector.error(reduced[index].mismatch))
        selection = selection.without_term(least, reduced[least])


def swap_terms(selector: Selector, selection: Selection) -> Selection:
    """Try rivals in the place of every term; the last had them all beside it, and only one that predicts takes it.

    What was best alone need not be best in company, and what is best one sample ahead need not predict. A swap that
    makes windows of unseen rows, simulated freely, worse is none.
    """
    before = selection.fit
    for index in range(selection.terms):
        for rival in _rivals(selection, index):
            if monotonic() > selector.deadline:
                break
            after_swap = _swap(selector, selection, index, rival)
            if after_swap is not None:
                selection = after_swap
                break
    return selection if selection.fit is before else judged_again(selector, selection)


def judged_again(selector: Selector, selection: Selection) -> Selection:
    """Every term judged beside what changed, and those gone whose work the others now do."""
    selection = backward_elimination(selector, selection)
    last = selection.terms - 1
    reduced = selector.settle_without(selection.fit, last)
    return selection.with_merit(last, selector.merit(selection, reduced, selection.fit))


def _swap(selector: Selector, selection: Selection, index: int, rival: Candidate) -> Selection | None:
    """The selection with a rival in the place of a term, if it does better there and deserves to come in."""
    last, left = index == selection.terms - 1, selection.entries[index].left
    near, nothing = rival.left <= SETTINGS.swap.near * left, rival.left <= left + SETTINGS.joint.nothing
    if last and not (near or nothing):
        return None
    fit = _instead(selector, selection.fit, index, rival)
    if fit is None:
        return None
    if last and nothing:  # both left next to nothing at first: which leaves less, their best fits say
        present, fit = selector.polished(selection.fit), selector.polished(fit)
        better = _better(selector, present, fit)
    else:
        better = not last and _better(selector, selection.fit, fit)
    if not better and not (near and _cost_ratio(selector, selection.fit, fit) <= SETTINGS.swap.near):
        return None
    merit = selector.merit(selection, selector.settle_without(fit, index), fit)
    most = SETTINGS.swap.no_worse if better else SETTINGS.swap.predicts
    if not selector.may_enter(selection, merit, fit, index) or not _predicts(selector, selection.fit, fit, most):
        return None
    entry = selection.entries[index]
    old = Candidate(selection.fit.hypothesis.terms[index].effect, selection.fit, entry.left, index)
    others = (old, *(c for c in entry.rivals if c.effect != rival.effect))
    entries = (*selection.entries[:index], TermEntry(entry.left, others), *selection.entries[index + 1 :])
    return replace(selection.with_merit(index, merit), fit=fit, entries=entries)


def _rivals(selection: Selection, index: int) -> tuple[Candidate, ...]:
    """Rivals of a term that stood close when it came in and are not in by now.

    What the term is a special case of is none: it leaves as little with more numbers, whatever the truth.
    """
    entry, terms = selection.entries[index], selection.fit.hypothesis.terms
    there = {term.effect for term in terms} | set(selection.rejected) | set(effect(terms[index].effect).within)
    most = SETTINGS.swap.within * entry.left
    close = tuple(c for c in entry.rivals if c.left <= most and c.effect not in there)
    return close[: SETTINGS.swap.most_tried]


def _instead(selector: Selector, fit: Fit, index: int, rival: Candidate) -> Fit | None:
    """The fit with a rival's term in the place of its own, started where the rival's fit ended."""
    terms = list(fit.hypothesis.terms)
    terms[index] = rival.term
    hypothesis = replace(fit.hypothesis, terms=tuple(terms))
    return settled(selector, hypothesis, _coordinates(fit, hypothesis, index, rival), fit.mismatch)


def settled(selector: Selector, hypothesis: Hypothesis, at: Array, mismatch: Array) -> Fit | None:
    """The hypothesis fitted from these coordinates; None where it makes no sense there."""
    try:
        return selector.settle(hypothesis, at, mismatch)
    except ValueError:
        return None


def _coordinates(fit: Fit, hypothesis: Hypothesis, index: int, rival: Candidate) -> Array:
    """Coordinates of the fit, with the rival's own, and with its values of what either of the two opens."""
    own = fit.hypothesis.share(index)
    at = np.concatenate([fit.coordinates[: own.start], rival.own, fit.coordinates[own.stop :]])
    opened = set(fit.hypothesis.terms[index].opens) | set(hypothesis.terms[index].opens)
    for base_index, unknown in enumerate(hypothesis.base):
        if unknown.key in opened:
            at[base_index] = rival.fit.coordinates[base_index]
    return np.asarray(at)


def _predicts(selector: Selector, old: Fit, new: Fit, most: float) -> bool:
    """Whether free windows of every length are off by no more than `most` times what the old fit's are, unseen."""
    predictor, folds = selector.predictor, make_folds(selector.predictor, old)
    was, now = (free_run_errors(predictor, predict_held_out(predictor, fit, folds), folds.judged) for fit in (old, new))
    return bool(np.all(now <= most * was))


def _better(selector: Selector, old: Fit, new: Fit) -> bool:
    """Whether the new fit costs less, in the scale of the old one."""
    better = SETTINGS.swap.better if _size(new) < _size(old) else -SETTINGS.swap.better
    return math.log(max(_cost_ratio(selector, old, new), 1e-30)) < better


def _cost_ratio(selector: Selector, old: Fit, new: Fit) -> float:
    """Cost of the new fit over that of the old one, in the old one's scale."""
    fitter = selector.fitter(old.mismatch)
    was, now = (fitter.cost(fit.hypothesis, fit.coordinates, fit.mismatch) for fit in (old, new))
    return now / max(was, 1e-30)


def _size(fit: Fit) -> int:
    return sum(term.numbers for term in fit.hypothesis.terms)


# --- Beyond stepwise selection ---------------------------------------------------------------------------------------
# What real machines need beyond stepwise selection: several terms at once, a slow drift, values put back.
#
# The later stages of the selection. Real machines have several effects none of which takes much of what is left, and
# all together do; and a constant torque that changes slowly, which is next to nothing in any row.


#: The effect and form of a slow change, and what it must be told from: friction that drifts, which turns with the
#: direction.
DRIFT, DRIFT_RIVAL = ("offset_drift", "straight"), ("thermal", "drift")

#: Parameters that are put back where the data do not mind: bristle, Stribeck curve, offset and delay show little in
#: most recordings, and a value that noise or the sample time has moved is no recalibration.
PUT_BACK = (
    "friction.sigma0",
    "friction.sigma1",
    "friction.static",
    "friction.stribeck_velocity",
    "torque_offset",
    "delay_s",
)


def above_floor(selector: Selector, selection: Selection) -> bool:
    """Whether terms came in, and what they left is more than forms and noise make."""
    return bool(selection.terms) and much_left(selector, selection)


def add_group(selector: Selector, selection: Selection) -> Selection:
    """Add the best terms one after the other, finer forms among them; all of them stay, or none.

    Forward selection adds a term only when it takes a good share of what is left. Here all together must.
    """
    longer = selection
    while longer.terms < SETTINGS.group.most_terms and monotonic() < selector.deadline:
        if selector.nothing_left(longer):
            break
        skip = names(lambda what: what.soaks_up) | frozenset(longer.rejected)
        candidates, tried = selector.candidates(longer.fit, True, skip)
        before = longer.terms
        longer = add_first(selector, replace(longer, tried=longer.tried + tried), candidates)
        if longer.terms == before:
            break
    if longer.fit is not selection.fit:
        together = selector.merit(longer, selection.fit, longer.fit)
        if together.of_left >= SETTINGS.group.least_together:
            return longer
    return replace(selection, floor=longer.floor)


def add_first(selector: Selector, selection: Selection, candidates: list[Candidate]) -> Selection:
    """Add the first of the best candidates that deserves it and whose fit is sound, if one does."""
    present = selection.fit
    deserves = partial(_deserves, selector, selection)
    for candidate in candidates[: SETTINGS.group.tried]:
        begun = selector.settle(candidate.fit.hypothesis, candidate.fit.coordinates, present.mismatch)
        fit, merit = selector.fit_on(selection, present, begun, deserves)
        selection = selector.lower_floor(selection, fit.mismatch)
        if deserves(merit, fit) and is_sound(merit, fit):
            others = tuple(c for c in candidates if c.effect != candidate.effect)
            return selection.with_term(fit, merit, TermEntry(candidate.left, others))
    return selection


def _deserves(selector: Selector, selection: Selection, merit: Merit, fit: Fit) -> bool:
    """Whether a term is significant and of some size."""
    of_size = merit.of_left >= SETTINGS.group.least_each and merit.torque >= SETTINGS.group.least_torque
    return of_size and selector.significant(selection, merit, fit)


def add_drift(selector: Selector, selection: Selection) -> Selection:
    """Add a drift of the offset where it takes a good share of what is left over a second.

    A slow change of the constant torque is next to nothing in any row, and most of what carries a simulation away: what
    is left is judged by its means over a second, as a simulation that runs freely for a second adds it up.
    """
    present = selection.fit
    there = {term.effect for term in present.hypothesis.terms}
    out = there | set(selection.rejected)
    if out & {DRIFT[0], DRIFT_RIVAL[0]} or not effect(DRIFT[0]).terms(_scene(selector, present)):
        return selection
    drift, merit = _fit_with(selector, selection, *DRIFT)
    left = _left(selector, present, drift)
    taken = left <= 1.0 - SETTINGS.drift.least_taken and _is_significant(selector, merit, 1.0 - left)
    if not taken or not is_sound(merit, drift):
        return selection
    other, _ = _fit_with(selector, selection, *DRIFT_RIVAL)
    rival = Candidate(DRIFT_RIVAL[0], other, _left(selector, present, other))
    return selection.with_term(drift, merit, TermEntry(left, (rival,)))


def _is_significant(selector: Selector, merit: Merit, taken: float = 0.0) -> bool:
    """Whether a term of one number is significant that takes a share of the means' power."""
    least = SETTINGS.drift.least_gain_of_most if taken >= SETTINGS.drift.most_taken else SETTINGS.drift.least_gain
    return merit.gain >= least + math.log(float(selector.rows.sum()))


def _fit_with(selector: Selector, selection: Selection, name: str, form: str) -> tuple[Fit, Merit]:
    """The fit with a form of an effect beside all that is in, fitted to its end, and what the effect is worth."""
    present = selection.fit
    term = next(term for term in effect(name).terms(_scene(selector, present)) if term.form == form)
    hypothesis = present.hypothesis.with_term(term)
    at = hypothesis.beside(present.coordinates)
    begun = selector.settle(hypothesis, at, present.mismatch, present.jacobian)
    return selector.fit_on(selection, present, begun, lambda merit, _fit: _is_significant(selector, merit))


def _scene(selector: Selector, present: Fit) -> SearchContext:
    return SearchContext(selector.start.document, selector.predictor, present.mismatch)


def _left(selector: Selector, old: Fit, new: Fit) -> float:
    """The share of the means' power that `new` leaves of what `old` left."""
    was, now = (power_of_means(selector.predictor, fit.mismatch) for fit in (old, new))
    return now / max(was, 1e-30)


def power_of_means(predictor: Predictor, mismatch: Array) -> float:
    """Power of the mismatch's means over a second, as a sum over all spans of all recordings, N^2*m^2."""
    found = []
    for part, trace in zip(predictor.slices, predictor.traces, strict=True):
        rows = max(8, round(SETTINGS.drift.span_s / trace.period_s))
        count = (part.stop - part.start) // rows
        found.append(mismatch[part][: count * rows].reshape(count, rows).mean(axis=1))
    return float(np.sum(np.concatenate(found) ** 2))


def restore_nominal(selector: Selector, selection: Selection) -> Selection:
    """Put as many of PUT_BACK at their nominal values as the data do not mind; those that a term opens stay.

    They are held for the fit alone: what is known of them, and so every interval, stays as it was.
    """
    fit = selection.fit
    opened = {key for term in fit.hypothesis.terms for key in term.opens}
    candidates = [key for key in PUT_BACK if key not in opened and any(u.key == key for u in fit.hypothesis.base)]
    restored = fit
    for keys in [candidates, *[[key] for key in candidates]]:
        held = _held(selector, restored, keys)
        if held is not None:
            restored = held
            if keys is candidates:
                break
    if restored is not fit:
        fit = selector.refresh(replace(restored, hypothesis=fit.hypothesis))
    return selector.lower_floor(replace(selection, fit=fit), fit.mismatch)


def _held(selector: Selector, fit: Fit, keys: list[str]) -> Fit | None:
    """The fit with `keys` at their nominal values, None where the data mind."""
    base = tuple(replace(u, spread=SETTINGS.reset.firm) if u.key in keys else u for u in fit.hypothesis.base)
    hypothesis = Hypothesis(fit.hypothesis.document, base, fit.hypothesis.terms)
    at = fit.coordinates.copy()
    for index, unknown in enumerate(base):
        if unknown.key in keys:
            at[index] = unknown.coordinate(unknown.start)
    fitter = selector.fitter(fit.mismatch)
    begun = fitter.begin(hypothesis, at, fit.jacobian)
    if begun is None:
        return None
    held = fitter.refine(begun, 3, len(at))
    changed = np.abs(held.mismatch - fit.mismatch)[selector.predictor.counts]
    if float(np.quantile(changed, 0.99)) > SETTINGS.reset.torque * selector.predictor.dry:
        return None
    grown = selector.error(held.mismatch) > (1.0 + SETTINGS.reset.error) * selector.error(fit.mismatch)
    return None if grown else held
