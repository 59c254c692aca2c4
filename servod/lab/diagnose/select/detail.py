"""Several effects at once, none of which takes much of what is left, and all together do: as real machines have them.

Stands behind the selection (`choose`), which adds a term only when it takes a good share of what is left. Here the best
terms come in one after the other, finer forms among them, and stay only when together they take a good share.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from time import monotonic

from servod.lab.diagnose.select.candidates import Candidate
from servod.lab.diagnose.select.choice import Choice, Entry
from servod.lab.diagnose.select.choose import Chooser, whole
from servod.lab.diagnose.select.fit import Fit
from servod.lab.diagnose.select.merit import Merit

#: Only where what is left above the noise floor is this share of dry friction, and this share of what was explainable.
MUCH_LEFT, LEFT_SHARE = 0.025, 0.08

#: Most terms, those of the selection included.
MOST_TERMS = 9

#: A term takes at least this share of what is left when it comes in; all of them together at least that share.
LEAST_EACH, LEAST_TOGETHER = 0.06, 0.35

#: A term acts with at least this share of dry friction, seen through the observer's low-pass.
LEAST_TORQUE = 0.025

#: Effects that soak up what others leave, and are too plain to be a detail where they are real.
SOAK_UP = frozenset(
    ("encoder_eccentricity", "position_dependent_inertia", "disturbance", "torque_saturation", "torque_ripple", "delay")
)

#: Candidates of a round that are tried until one deserves to come in.
TRIED = 3


def detail(chooser: Chooser, choice: Choice) -> None:
    """Add terms to `choice`, all or none of them."""
    refined = replace(choice, merits=list(choice.merits), entries=list(choice.entries))
    while len(refined.fit.hypothesis.terms) < MOST_TERMS and monotonic() < chooser.deadline:
        if chooser.nothing_left(refined.fit.mismatch):
            break
        if not take_first(chooser, refined, chooser.candidates(refined.fit, True, SOAK_UP)):
            break
    if refined.fit is choice.fit or chooser.merit(choice.fit, refined.fit).of_left < LEAST_TOGETHER:
        return
    choice.fit, choice.merits, choice.entries = refined.fit, refined.merits, refined.entries
    choice.tried, choice.floor = chooser.tried, chooser.floor


def much_left(chooser: Chooser, choice: Choice) -> bool:
    """Whether terms came in, and what they left is more than forms and noise make."""
    if not choice.fit.hypothesis.terms:
        return False
    left = chooser.error(choice.fit.mismatch) - chooser.floor
    explainable = max(chooser.base_error - chooser.floor, 1e-30)
    return left > LEFT_SHARE * explainable and math.sqrt(max(left, 0.0)) > MUCH_LEFT * chooser.predictor.dry


def take_first(chooser: Chooser, choice: Choice, candidates: list[Candidate]) -> bool:
    """Take in the first of the best candidates that deserves it and whose fit is whole; whether one did."""
    present = choice.fit
    deserves = partial(_deserves, chooser)
    for candidate in candidates[:TRIED]:
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
    return merit.of_left >= LEAST_EACH and merit.torque >= LEAST_TORQUE and chooser.significant(merit, fit)
