"""From a choice of terms to a verdict: what is a finding, what was only recalibrated, how sure, and what is left.

Stands between the selection and the document. The levels of the outside contract are applied here once more to what the
fit says, so that a term whose value came back under its level is recalibration.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from servod.lab.diagnose.effects import effect, effects
from servod.lab.diagnose.effects.hypothesis import Document, get
from servod.lab.diagnose.select.candidates import Candidate
from servod.lab.diagnose.select.choice import Choice
from servod.lab.diagnose.select.fit import Fit

Array = NDArray[np.float64]

#: Below this share of the explainable error no known name may stand: what is there is something else. Real machines
#: keep some of theirs above it, so that it is no nearer to 1; confidence falls with what is left instead. It is nearer
#: where what is left is worth a name itself, from this share of dry friction on.
LEAST_EXPLAINED, LEAST_BESIDE_MUCH, MUCH_TORQUE = 0.85, 0.925, 0.05

#: What is left above the noise floor counts as unexplained from this share of dry friction, if it is also this share of
#: what could be explained.
LEFT_TORQUE, LEFT_SHARE = 0.02, 0.05

#: Shares of dry friction from which the encoder's noise in the mismatch hides what is left, and hides everything.
HIDES_REST, HIDES_ALL = 0.15, 0.5

#: A rival that leaves at most this many times what the finding leaves cannot be told apart.
ALIKE = 1.2

#: Confidence 0.5 + 0.49*(1 - exp(-gap/GAP)); gap: logarithm of what the best rival leaves over what the finding leaves.
GAP = 0.15


#: From this share of the explainable error removed on, what is left says nothing against the names.
FULLY = 0.95


class Verdict(StrEnum):
    """The outside contract's verdicts, and one for data that can tell nothing."""

    ADEQUATE = "adequate"
    MISSING_PHYSICS = "missing_physics"
    UNEXPLAINED = "unexplained"
    CANNOT_TELL = "cannot_tell"


@dataclass(frozen=True)
class Shares:
    """Errors as root mean squares of the mismatch, N*m, and the share of the explainable error that was removed."""

    before: float
    after: float
    floor: float
    removed: float

    @property
    def left(self) -> float:
        """What is left above the noise floor, N*m."""
        return math.sqrt(max(self.after**2 - self.floor**2, 0.0))


def shares(mismatch: tuple[Array, Array], counts: NDArray[np.bool_], floor: float) -> Shares:
    """Errors of two mismatches, before and after, over the rows that count; `floor` is a mean square."""
    before, after = (float(np.mean(rows[counts] ** 2)) for rows in mismatch)
    removed = (before - after) / max(before - floor, 1e-30)
    return Shares(math.sqrt(before), math.sqrt(after), math.sqrt(floor), min(max(removed, 0.0), 1.0))


def verdict(choice: Choice, named: list[int], errors: Shares, dry: float) -> Verdict:
    """The verdict on what was named (places of terms) and what is left."""
    left = errors.left / dry
    much = left > LEFT_TORQUE and 1.0 - errors.removed > LEFT_SHARE
    least = LEAST_BESIDE_MUCH if left > MUCH_TORQUE else LEAST_EXPLAINED
    if much and (not named or errors.removed < least):
        return Verdict.UNEXPLAINED
    return Verdict.MISSING_PHYSICS if named else Verdict.ADEQUATE


def drowned(found: Verdict, encoder_noise: float, dry: float) -> bool:
    """Whether a verdict without a name says nothing, because the encoder's noise is as large as what it is about."""
    hides = {Verdict.UNEXPLAINED: HIDES_REST, Verdict.ADEQUATE: HIDES_ALL}
    return found in hides and encoder_noise > hides[found] * dry


def named_terms(choice: Choice, nominal: Document) -> list[int]:
    """Places of the terms whose effect is at least at its level."""
    fitted = choice.fit.hypothesis.written(choice.fit.coordinates)
    terms, lesser = choice.fit.hypothesis.terms, lesser_twin(choice.fit)
    return [
        i for i, term in enumerate(terms) if term.effect != lesser and effect(term.effect).at_level(nominal, fitted)
    ]


def lesser_twin(fit: Fit) -> str:
    """The shorter of a delay and a lag that are both in: together they are one drive that is late, of higher order."""
    there = {term.effect for term in fit.hypothesis.terms}
    pairs = [(found, effect(found.twin)) for found in effects() if found.name in there and found.twin in there]
    if not pairs:
        return ""
    fitted, (one, other) = fit.hypothesis.written(fit.coordinates), pairs[0]
    late, later = get(fitted, one.lateness), get(fitted, other.lateness)
    return one.name if late < later else other.name if later > 0.0 else ""  # a limited rate is no twin


def confidence(choice: Choice, index: int, removed: float) -> float:
    """Probability that the name of a term is right, from how far its best rival stayed behind.

    `removed` is the share of the explainable error that all names together remove: what they leave may be their fault.
    """
    own = len(choice.fit.hypothesis.terms[index].unknowns)
    gaps = [math.log(max(ratio, 1.0)) + GAP * _more_unknowns(rival, own) for rival, ratio in _rivals(choice, index)]
    sure = 0.5 + 0.49 * (1.0 - math.exp(-min(gaps, default=math.inf) / GAP))
    return round(sure * min(1.0, removed / FULLY), 3)


def _more_unknowns(rival: Candidate, own: int) -> int:
    """Unknowns that a rival needs beyond the finding's own: one that only does as well with more is no evidence."""
    return max(len(rival.term.unknowns) - own, 0)


def alternatives(choice: Choice, index: int) -> list[str]:
    """Effects that these data cannot tell apart from a term; its twin too where that is in beside it."""
    terms = choice.fit.hypothesis.terms
    twin = effect(terms[index].effect).twin
    beside = [term.effect for term in terms if term.effect == twin]
    return beside + [rival.effect for rival, ratio in _rivals(choice, index) if ratio <= ALIKE and rival.effect != twin]


def _rivals(choice: Choice, index: int) -> list[tuple[Candidate, float]]:
    """Rivals of a term and what each left of the cost over what the term left, when the term came in."""
    entry = choice.entries[index]
    return [(rival, rival.left / max(entry.left, 1e-12)) for rival in entry.rivals]
