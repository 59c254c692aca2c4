"""Follows a narrow valley of the cost to its bottom.

Stands between the fit and what is told. Friction that grows with the torque, mass and friction of the model's own do
nearly the same together: Gauss-Newton comes down into such a valley and stops on its floor, far from its lowest place,
where the floor falls less than a step can tell. Along the direction of least curvature steps are doubled while the cost
falls, all numbers are fitted again, and the way that both went is gone on (pattern move: Hooke and Jeeves, Journal of
the ACM 8, 1961).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from time import monotonic

import numpy as np
from numpy.typing import NDArray

from servod.lab.diagnose.select.fit import Fit, Fitter

Array = NDArray[np.float64]

#: Rounds at most, the share of the cost that a round must gain to be followed by another, and doublings in a search.
ROUNDS, LEAST_GAIN, DOUBLINGS = 8, 5e-4, 8

#: First steps of a search along the direction of least curvature, in its standard deviations: a shorter one where the
#: valley bends away from a longer one.
FIRSTS = (2.0, 0.4, 0.08)


def follow(fitter: Fitter, refine: Callable[[Fit], Fit], fit: Fit, deadline: float = math.inf) -> Fit:
    """The fit moved along its valley while that gains enough, and until the monotonic time `deadline`.

    `refine` fits all numbers in the scale of `fitter`.
    """
    for _ in range(ROUNDS):
        if monotonic() > deadline:
            break
        jacobian = fitter.derivatives(fit)
        moved = _begin(fitter, fit, _least_curved(fitter, fit, jacobian))
        if moved is None:
            return fit
        refined = refine(moved)
        further = _search(fitter, refined, refined.coordinates - fit.coordinates)
        ended = refined if further is refined else refine(further)
        if ended.cost > (1.0 - LEAST_GAIN) * fit.cost:
            return ended if ended.cost < fit.cost else fit
        fit = ended
    return fit


def _least_curved(fitter: Fitter, fit: Fit, jacobian: Array) -> Array:
    """One standard deviation along the direction in which the cost rises least, coordinates told in their own."""
    normal, _ = fitter.normal(fit, jacobian)
    own = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    values, vectors = np.linalg.eigh(own[:, None] * normal * own[None, :])
    return np.asarray(own * vectors[:, 0] / np.sqrt(max(float(values[0]), 1e-12)))


def _begin(fitter: Fitter, fit: Fit, deviation: Array) -> Fit | None:
    """A better place along a direction, either way, by the longest first step that finds one; None where none does."""
    for first in FIRSTS:
        for way in (first * deviation, -first * deviation):
            found = _search(fitter, fit, way)
            if found is not fit:
                return found
    return None


def _search(fitter: Fitter, fit: Fit, step: Array) -> Fit:
    """The best of ever longer steps while the cost falls."""
    best = fit
    for doubling in range(DOUBLINGS):
        at = np.clip(fit.coordinates + 2.0**doubling * step, *fit.hypothesis.bounds)
        mismatch = fitter.mismatch(fit.hypothesis, at)
        cost = np.inf if mismatch is None else fitter.cost(fit.hypothesis, at, mismatch)
        if mismatch is None or cost >= best.cost:
            break
        best = replace(fit, coordinates=at, mismatch=mismatch, cost=cost, converged=False)
    return best
