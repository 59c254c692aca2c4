"""From a choice of terms to a verdict: what is a finding, what was only recalibrated, how sure, and what is left.

Stands between the selection and the document. The levels of the outside contract are applied here once more to what the
fit says, so that a term whose value came back under its level is recalibration.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from servod.lab.diagnose.effects.base import BRISTLE_FACTOR, DELAY_S, OFFSET_SHARE, RECALIBRATION, STRIBECK_SHARE
from servod.lab.diagnose.effects.hypothesis import Document, get
from servod.lab.diagnose.result import Verdict
from servod.lab.diagnose.select.candidates import Candidate
from servod.lab.diagnose.select.choice import Choice
from servod.lab.diagnose.select.fit import Fit
from servod.lab.diagnose.settings import SETTINGS

Array = NDArray[np.float64]

#: A delay and a lag that are in together are one finding, by the name of the longer.
TWINS = {"delay": "actuator_lag", "actuator_lag": "delay"}


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
    much = left > SETTINGS.verdict.left_torque and 1.0 - errors.removed > SETTINGS.verdict.left_share
    least = (
        SETTINGS.verdict.least_beside_much if left > SETTINGS.verdict.much_torque else SETTINGS.verdict.least_explained
    )
    if much and (not named or errors.removed < least):
        return Verdict.UNEXPLAINED
    return Verdict.MISSING_PHYSICS if named else Verdict.ADEQUATE


def drowned(found: Verdict, encoder_noise: float, dry: float) -> bool:
    """Whether a verdict without a name says nothing, because the encoder's noise is as large as what it is about."""
    hides = {Verdict.UNEXPLAINED: SETTINGS.verdict.hides_rest, Verdict.ADEQUATE: SETTINGS.verdict.hides_all}
    return found in hides and encoder_noise > hides[found] * dry


def named_terms(choice: Choice, nominal: Document) -> list[int]:
    """Places of the terms whose effect is at least at its level."""
    fitted = choice.fit.hypothesis.written(choice.fit.coordinates)
    terms, lesser = choice.fit.hypothesis.terms, lesser_twin(choice.fit)
    return [i for i, term in enumerate(terms) if term.effect != lesser and _at_level(term.effect, nominal, fitted)]


def lesser_twin(fit: Fit) -> str:
    """The shorter of a delay and a lag that are both in: together they are one drive that is late, of higher order."""
    if not {term.effect for term in fit.hypothesis.terms} >= set(TWINS):
        return ""
    fitted = fit.hypothesis.written(fit.coordinates)
    late, lag = get(fitted, "delay.additional_s"), get(fitted, "actuator_lag.time_constant_s")
    return "delay" if late < lag else "actuator_lag" if lag > 0.0 else ""  # a limited rate is no twin


def _at_level(effect: str, nominal: Document, fitted: Document) -> bool:
    """Whether an effect that is a level of the model's own parameters has left its band."""
    coulomb = get(nominal, "friction.coulomb")
    if effect == "inertia":
        return _factor(nominal, fitted, "inertia") >= 1.0 + RECALIBRATION
    if effect == "torque_offset":
        return abs(get(fitted, "torque_offset") - get(nominal, "torque_offset")) >= OFFSET_SHARE * coulomb
    if effect == "delay":
        return abs(get(fitted, "delay.additional_s") + get(fitted, "delay_s") - get(nominal, "delay_s")) >= DELAY_S
    if effect == "presliding" and get(nominal, "friction.sigma0") > 0.0 and "presliding" not in fitted:
        return max(_factor(nominal, fitted, f"friction.{key}") for key in ("sigma0", "sigma1")) >= BRISTLE_FACTOR
    if effect == "stribeck" and "stribeck" not in fitted:
        was, now = (get(d, "friction.static") - get(d, "friction.coulomb") for d in (nominal, fitted))
        return abs(now - was) >= STRIBECK_SHARE * coulomb
    if effect == "torque_gain":
        factors = [get(fitted, f"torque_gain.{key}", 1.0) for key in ("factor", "negative_factor")]
        return max(max(f, 1.0 / f) for f in factors) >= 1.0 + RECALIBRATION
    if effect == "torque_ripple":
        return _largest_wave(fitted, effect) >= SETTINGS.verdict.ripple_share
    return True


def _largest_wave(fitted: Document, effect: str) -> float:
    """Amplitude of the largest sine over position of an effect."""
    return max((float(row["amplitude"]) for row in fitted.get(effect, {}).get("harmonics", [])), default=0.0)


def _factor(nominal: Document, fitted: Document, key: str) -> float:
    was, now = get(nominal, key), get(fitted, key)
    return max(was, now) / min(was, now) if min(was, now) > 0.0 else 1.0


def confidence(choice: Choice, index: int, removed: float) -> float:
    """Probability that the name of a term is right, from how far its best rival stayed behind.

    `removed` is the share of the explainable error that all names together remove: what they leave may be their fault.
    """
    own = len(choice.fit.hypothesis.terms[index].unknowns)
    gaps = [
        math.log(max(ratio, 1.0)) + SETTINGS.verdict.gap_scale * _more_unknowns(rival, own)
        for rival, ratio in _rivals(choice, index)
    ]
    sure = 0.5 + 0.49 * (1.0 - math.exp(-min(gaps, default=math.inf) / SETTINGS.verdict.gap_scale))
    return round(sure * min(1.0, removed / SETTINGS.verdict.fully), 3)


def _more_unknowns(rival: Candidate, own: int) -> int:
    """Unknowns that a rival needs beyond the finding's own: one that only does as well with more is no evidence."""
    return max(len(rival.term.unknowns) - own, 0)


def alternatives(choice: Choice, index: int) -> list[str]:
    """Effects that these data cannot tell apart from a term; its twin too where that is in beside it."""
    terms = choice.fit.hypothesis.terms
    twin = TWINS.get(terms[index].effect)
    beside = [term.effect for term in terms if term.effect == twin]
    return beside + [
        rival.effect
        for rival, ratio in _rivals(choice, index)
        if ratio <= SETTINGS.verdict.alike and rival.effect != twin
    ]


def _rivals(choice: Choice, index: int) -> list[tuple[Candidate, float]]:
    """Rivals of a term and what each left of the cost over what the term left, when the term came in."""
    entry = choice.entries[index]
    return [(rival, rival.left / max(entry.left, 1e-12)) for rival in entry.rivals]
