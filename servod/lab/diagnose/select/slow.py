"""A slow change of the constant torque: next to nothing in any row, and most of what carries a simulation away.

Stands behind `detail`, for real machines with several effects at once: what is left of the mismatch is judged by its
means over a second, as a simulation that runs freely for a second adds it up.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from servod.lab.diagnose.effects import effect
from servod.lab.diagnose.effects.scene import Scene
from servod.lab.diagnose.predict.predict import Predictor
from servod.lab.diagnose.select.candidates import Candidate
from servod.lab.diagnose.select.choice import Choice, Entry
from servod.lab.diagnose.select.choose import Chooser, whole
from servod.lab.diagnose.select.fit import Fit
from servod.lab.diagnose.select.merit import Merit

Array = NDArray[np.float64]

#: Length over which the mismatch is averaged, s; and the share of the means' power that a drift must take.
SPAN_S, LEAST_TAKEN = 1.0, 0.15

#: What it must gain beyond the Bayesian information criterion, in units of noise; one thing is tried, not hundreds.
LEAST_GAIN = 20.0

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
    if left > 1.0 - LEAST_TAKEN or not _gains(chooser, merit) or not whole(merit, drift):
        return
    other, _ = _with(chooser, present, *RIVAL)
    choice.fit = drift
    choice.merits.append(merit)
    choice.entries.append(Entry(left, [Candidate(RIVAL[0], other, _left(chooser, present, other))]))


def _gains(chooser: Chooser, merit: Merit) -> bool:
    """Whether a term of one number is significant."""
    return merit.gain >= LEAST_GAIN + math.log(float(chooser.rows.sum()))


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
    """Means of the mismatch over each span of SPAN_S of all recordings, N*m."""
    found = []
    for part, trace in zip(predictor.slices, predictor.traces, strict=True):
        rows = max(8, round(SPAN_S / trace.period_s))
        count = (part.stop - part.start) // rows
        found.append(mismatch[part][: count * rows].reshape(count, rows).mean(axis=1))
    return np.concatenate(found)
