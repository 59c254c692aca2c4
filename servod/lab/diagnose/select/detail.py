"""Several effects at once, none of which takes much of what is left, and all together do: as real machines have them.

Stands behind the selection (`choose`), which adds a term only when it takes a good share of what is left. Here the best
terms come in one after the other, finer forms among them, and stay only when together they take a good share.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from time import monotonic

import numpy as np
from numpy.typing import NDArray

from servod.lab.diagnose.effects import effect
from servod.lab.diagnose.effects.hypothesis import Hypothesis
from servod.lab.diagnose.effects.scene import Scene
from servod.lab.diagnose.predict.predict import Predictor
from servod.lab.diagnose.select.candidates import Candidate
from servod.lab.diagnose.select.choice import Choice, Entry
from servod.lab.diagnose.select.choose import Chooser, whole
from servod.lab.diagnose.select.fit import Fit
from servod.lab.diagnose.select.merit import Merit
from servod.lab.diagnose.settings import SETTINGS

#: Effects that soak up what others leave, and are too plain to be a detail where they are real.
SOAK_UP = frozenset(
    ("encoder_eccentricity", "position_dependent_inertia", "disturbance", "torque_saturation", "torque_ripple", "delay")
)


def detail(chooser: Chooser, choice: Choice) -> None:
    """Add terms to `choice`, all or none of them."""
    refined = replace(choice, merits=list(choice.merits), entries=list(choice.entries))
    while len(refined.fit.hypothesis.terms) < SETTINGS.group.most_terms and monotonic() < chooser.deadline:
        if chooser.nothing_left(refined.fit.mismatch):
            break
        if not take_first(chooser, refined, chooser.candidates(refined.fit, True, SOAK_UP)):
            break
    if refined.fit is choice.fit or chooser.merit(choice.fit, refined.fit).of_left < SETTINGS.group.least_together:
        return
    choice.fit, choice.merits, choice.entries = refined.fit, refined.merits, refined.entries
    choice.tried, choice.floor = chooser.tried, chooser.floor


def much_left(chooser: Chooser, choice: Choice) -> bool:
    """Whether terms came in, and what they left is more than forms and noise make."""
    if not choice.fit.hypothesis.terms:
        return False
    left = chooser.error(choice.fit.mismatch) - chooser.floor
    explainable = max(chooser.base_error - chooser.floor, 1e-30)
    return (
        left > SETTINGS.group.left_share * explainable
        and math.sqrt(max(left, 0.0)) > SETTINGS.group.much_left * chooser.predictor.dry
    )


def take_first(chooser: Chooser, choice: Choice, candidates: list[Candidate]) -> bool:
    """Take in the first of the best candidates that deserves it and whose fit is whole; whether one did."""
    present = choice.fit
    deserves = partial(_deserves, chooser)
    for candidate in candidates[: SETTINGS.group.tried]:
        begun = chooser.settled(candidate.fit.hypothesis, candidate.fit.coordinates, present.mismatch)
        settled, merit = chooser.to_end(present, begun, deserves)
        chooser.lower_floor(settled.mismatch)
        if deserves(merit, settled) and whole(merit, settled):
            _take(choice, candidate, candidates, settled, merit)
            return True
    return False


def _take(choice: Choice, candidate: Candidate, candidates: list[Candidate], settled: Fit, merit: Merit) -> None:
    """Put a term into the choice."""
    choice.fit = settled
    choice.merits.append(merit)
    choice.entries.append(Entry(candidate.left, [c for c in candidates if c.effect != candidate.effect]))


def _deserves(chooser: Chooser, merit: Merit, fit: Fit) -> bool:
    """Whether a term is significant and of some size."""
    return (
        merit.of_left >= SETTINGS.group.least_each
        and merit.torque >= SETTINGS.group.least_torque
        and chooser.significant(merit, fit)
    )


# Puts rivals in the place of terms that came in before others: what was best alone need not be best in company.
#
# Stands behind the selection and before the proof.


Array = NDArray[np.float64]


def swapped(chooser: Chooser, choice: Choice) -> None:
    """Try rivals in the place of every term but the last, which had them all beside it."""
    before = choice.fit
    for index in range(len(choice.fit.hypothesis.terms) - 1):
        for rival in _rivals(choice, index):
            if monotonic() > chooser.deadline or _swap(chooser, choice, index, rival):
                break
    if choice.fit is not before:
        _judge_anew(chooser, choice)


def _swap(chooser: Chooser, choice: Choice, index: int, rival: Candidate) -> bool:
    """Put a rival in the place of a term if it does better there and deserves to come in; whether it did."""
    other = _instead(chooser, choice.fit, index, rival)
    if other is None or not _better(chooser, choice.fit, other):
        return False
    merit = chooser.merit(chooser.less(other, index), other)
    if not chooser.enters(merit, other, index):
        return False
    entry = choice.entries[index]
    old = Candidate(choice.fit.hypothesis.terms[index].effect, choice.fit, entry.left, index)
    rest = [c for c in entry.rivals if c.effect != rival.effect]
    choice.entries[index] = Entry(entry.left, [old, *rest])
    choice.merits[index] = merit
    choice.fit = other
    return True


def _judge_anew(chooser: Chooser, choice: Choice) -> None:
    """Drop terms whose work a term that was put in now does, and say what each of the others is worth beside it."""
    chooser.prune(choice)
    last = len(choice.fit.hypothesis.terms) - 1
    choice.merits[last] = chooser.merit(chooser.less(choice.fit, last), choice.fit)


def _rivals(choice: Choice, index: int) -> list[Candidate]:
    """Rivals of a term that stood close when it came in and are not in by now."""
    entry, there = choice.entries[index], {term.effect for term in choice.fit.hypothesis.terms}
    return [c for c in entry.rivals if c.left <= SETTINGS.swap.within * entry.left and c.effect not in there][
        : SETTINGS.swap.most_tried
    ]


def _instead(chooser: Chooser, fit: Fit, index: int, rival: Candidate) -> Fit | None:
    """The fit with a rival's term in the place of its own, started where the rival's fit ended."""
    terms = list(fit.hypothesis.terms)
    terms[index] = rival.term
    hypothesis = replace(fit.hypothesis, terms=tuple(terms))
    at = _coordinates(fit, hypothesis, index, rival)
    try:
        return chooser.settled(hypothesis, at, fit.mismatch)
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


def _better(chooser: Chooser, old: Fit, new: Fit) -> bool:
    """Whether the new fit costs less, in the scale of the old one."""
    fitter = chooser.fitter(old.mismatch)
    was, now = (fitter.cost(fit.hypothesis, fit.coordinates, fit.mismatch) for fit in (old, new))
    fewer = _size(new) < _size(old)
    return math.log(max(now, 1e-30) / max(was, 1e-30)) < (SETTINGS.swap.better if fewer else -SETTINGS.swap.better)


def _size(fit: Fit) -> int:
    return sum(term.numbers for term in fit.hypothesis.terms)


# A slow change of the constant torque: next to nothing in any row, and most of what carries a simulation away.
#
# Stands behind `detail`, for real machines with several effects at once: what is left of the mismatch is judged by its
# means over a second, as a simulation that runs freely for a second adds it up.


#: The effect and its form, and what it must be told from: friction that drifts, which turns with the direction.
WANTED, RIVAL = ("offset_drift", "straight"), ("thermal", "drift")


def slow(chooser: Chooser, choice: Choice) -> None:
    """Add a drift of the offset where it takes a good share of what is left over a second."""
    present = choice.fit
    there = {term.effect for term in present.hypothesis.terms}
    if there & {WANTED[0], RIVAL[0]} or not effect(WANTED[0]).terms(_scene(chooser, present)):
        return
    drift, merit = _with(chooser, present, *WANTED)
    left = _left(chooser, present, drift)
    if left > 1.0 - SETTINGS.drift.least_taken or not _gains(chooser, merit) or not whole(merit, drift):
        return
    other, _ = _with(chooser, present, *RIVAL)
    choice.fit = drift
    choice.merits.append(merit)
    choice.entries.append(Entry(left, [Candidate(RIVAL[0], other, _left(chooser, present, other))]))


def _gains(chooser: Chooser, merit: Merit) -> bool:
    """Whether a term of one number is significant."""
    return merit.gain >= SETTINGS.drift.least_gain + math.log(float(chooser.rows.sum()))


def _with(chooser: Chooser, present: Fit, name: str, form: str) -> tuple[Fit, Merit]:
    """The fit with a form of an effect beside all that is in, fitted to its end, and what the effect is worth."""
    term = next(term for term in effect(name).terms(_scene(chooser, present)) if term.form == form)
    hypothesis = present.hypothesis.with_term(term)
    chooser.tried += 1
    at = hypothesis.beside(present.coordinates)
    begun = chooser.settled(hypothesis, at, present.mismatch, present.jacobian)
    return chooser.to_end(present, begun, lambda merit, _fit: _gains(chooser, merit))


def _scene(chooser: Chooser, present: Fit) -> Scene:
    return Scene(chooser.start.document, chooser.predictor, present.mismatch)


def _left(chooser: Chooser, old: Fit, new: Fit) -> float:
    """The share of the means' power that `new` leaves of what `old` left."""
    was, now = (power(chooser.predictor, fit.mismatch) for fit in (old, new))
    return now / max(was, 1e-30)


def power(predictor: Predictor, mismatch: Array) -> float:
    """Power of the mismatch's means over a second, as a sum over all of them, N^2*m^2."""
    return float(np.sum(means(predictor, mismatch) ** 2))


def means(predictor: Predictor, mismatch: Array) -> Array:
    """Means of the mismatch over each second of all recordings, N*m."""
    found = []
    for part, trace in zip(predictor.slices, predictor.traces, strict=True):
        rows = max(8, round(SETTINGS.drift.span_s / trace.period_s))
        count = (part.stop - part.start) // rows
        found.append(mismatch[part][: count * rows].reshape(count, rows).mean(axis=1))
    return np.concatenate(found)


# Puts parameters back that were moved for nothing: where the nominal value does as well, it stands.
#
# Stands between the selection and the proof. Stiffness and damping of the bristle, the Stribeck curve, offset and delay
# show little in most recordings; a value that noise or the sample time has moved is no recalibration.


#: Parameters that are put back where the data do not mind.
LEVELS = (
    "friction.sigma0",
    "friction.sigma1",
    "friction.static",
    "friction.stribeck_velocity",
    "torque_offset",
    "delay_s",
)


def tidied(chooser: Chooser, fit: Fit) -> Fit:
    """The fit with as many of LEVELS at their nominal values as the data do not mind; those that a term opens stay.

    They are held for the fit alone: what is known of them, and so every interval, stays as it was.
    """
    opened = {key for term in fit.hypothesis.terms for key in term.opens}
    candidates = [key for key in LEVELS if key not in opened and any(u.key == key for u in fit.hypothesis.base)]
    tidy = fit
    for keys in [candidates, *[[key] for key in candidates]]:
        held = _held(chooser, tidy, keys)
        if held is not None:
            tidy = held
            if keys is candidates:
                break
    return fit if tidy is fit else chooser.fresh(replace(tidy, hypothesis=fit.hypothesis))


def _held(chooser: Chooser, fit: Fit, keys: list[str]) -> Fit | None:
    """The fit with `keys` at their nominal values, None where the data mind."""
    base = tuple(replace(u, spread=SETTINGS.reset.firm) if u.key in keys else u for u in fit.hypothesis.base)
    hypothesis = Hypothesis(fit.hypothesis.document, base, fit.hypothesis.terms)
    at = fit.coordinates.copy()
    for index, unknown in enumerate(base):
        if unknown.key in keys:
            at[index] = unknown.coordinate(unknown.start)
    fitter = chooser.fitter(fit.mismatch)
    begun = fitter.begin(hypothesis, at, fit.jacobian)
    if begun is None:
        return None
    held = fitter.refine(begun, 3, len(at))
    changed = np.abs(held.mismatch - fit.mismatch)[chooser.predictor.counts]
    if float(np.quantile(changed, 0.99)) > SETTINGS.reset.torque * chooser.predictor.dry:
        return None
    return held if chooser.error(held.mismatch) <= (1.0 + SETTINGS.reset.error) * chooser.error(fit.mismatch) else None
