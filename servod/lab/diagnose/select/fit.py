"""Damped Gauss-Newton on the torque mismatch: robust, within bounds, with what is known beforehand.

Stands between hypotheses and their selection. The residual of the fit is the mismatch of every row in units of its
present scale; beyond some scales a row counts by its distance only (Huber). Intervals count correlated rows as fewer
(batch means: Carlstein, Annals of Statistics 14, 1986).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from time import monotonic
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from servod.formats.model.axis_model import AxisModel
from servod.lab.diagnose.effects.hypothesis import Hypothesis
from servod.lab.diagnose.predict.predict import Predictor, in_parallel
from servod.lab.diagnose.select.common_factor import believed_factor
from servod.lab.diagnose.settings import SETTINGS

Array = NDArray[np.float64]


class Weighing(NamedTuple):
    """Scale of the mismatch in which costs are counted (N*m), and the rows that take part as weights 0 or 1."""

    scale: float
    rows: Array


@dataclass(frozen=True)
class Fit:
    """A fitted hypothesis: coordinates, mismatch of all rows, cost, and the Jacobian where it was last computed.

    `span` is the least that its derivatives are taken over: more than 0 where fine ones led nowhere.
    """

    hypothesis: Hypothesis
    coordinates: Array
    mismatch: Array
    cost: float
    jacobian: Array
    converged: bool
    span: float = 0.0

    @property
    def model(self) -> AxisModel:
        """The fitted axis model."""
        return self.hypothesis.model(self.coordinates)

    @property
    def values(self) -> list[float]:
        """Values of the unknowns."""
        return self.hypothesis.values(self.coordinates)


def robust_cost(mismatch: Array, weighing: Weighing) -> float:
    """Sum of Huber's loss over the rows that take part."""
    off = np.abs(mismatch) / weighing.scale
    loss = np.where(off <= SETTINGS.fit.huber, 0.5 * off * off, SETTINGS.fit.huber * (off - 0.5 * SETTINGS.fit.huber))
    return float(weighing.rows @ loss)


def prior_cost(hypothesis: Hypothesis, coordinates: Array, centre: Array) -> float:
    """What the coordinates cost against what was known beforehand."""
    off = (coordinates - centre) * hypothesis.prior[1]
    return 0.5 * float(off @ off)


class Fitter:
    """Fits hypotheses to one set of recordings."""

    def __init__(self, predictor: Predictor, weighing: Weighing) -> None:
        self.predictor = predictor
        self.weighing = weighing

    def mismatch(self, hypothesis: Hypothesis, coordinates: Array) -> Array | None:
        """Mismatch of all rows, or None where the model makes no sense."""
        try:
            return self.predictor.mismatch(*hypothesis.models(coordinates, len(self.predictor.traces)))
        except ValidationError:
            return None

    def cost(self, hypothesis: Hypothesis, coordinates: Array, mismatch: Array) -> float:
        """Cost of data and prior."""
        return robust_cost(mismatch, self.weighing) + prior_cost(hypothesis, coordinates, hypothesis.prior[0])

    def begin(
        self, hypothesis: Hypothesis, coordinates: Array | None = None, jacobian: Array | None = None
    ) -> Fit | None:
        """The hypothesis at its start (or at `coordinates`), with as many columns of a Jacobian as are known."""
        low, high = hypothesis.bounds
        at = np.clip(hypothesis.start if coordinates is None else coordinates, low, high)
        mismatch = self.mismatch(hypothesis, at)
        if mismatch is None:
            return None
        known = np.zeros((len(mismatch), 0)) if jacobian is None else jacobian
        # A map follows falling friction where a curve is smooth: along it the mismatch is rough as a rule.
        span = SETTINGS.fit.wide if hypothesis.document["friction"]["kind"] == "local" else 0.0
        return Fit(hypothesis, at, mismatch, self.cost(hypothesis, at, mismatch), known, False, span)

    def predicted_cost(self, fit: Fit) -> float:
        """The cost after one step along the columns of the Jacobian that are known, by the Jacobian alone."""
        columns = fit.jacobian.shape[1]
        normal, slope = self.normal(fit, fit.jacobian)
        return fit.cost - 0.5 * float(slope @ np.linalg.solve(normal + 1e-9 * np.eye(columns), slope))

    def refine(self, fit: Fit, steps: int, keep_columns: int = 0, tries: int = 4, known: int = 0) -> Fit:
        """Go on fitting for some steps; the first `keep_columns` columns of the Jacobian are taken as they are.

        The first `known` are taken as they are to begin with. The Jacobian follows the steps by secants (Broyden, Math.
        Comp. 19, 1965) and is taken again when they stop to help; a fit ends only on a fresh one. Where that promises
        much and no step along it helps, the mismatch is rough: a model that sticks and slips along falling friction
        does so elsewhere after the least change. Then the derivatives are taken over a wider span.
        """
        return self._as_believed(self._descend(fit, steps, keep_columns, tries, known))

    def _descend(self, fit: Fit, steps: int, keep_columns: int, tries: int, known: int) -> Fit:
        damping, fresh = SETTINGS.fit.least_damping, known <= keep_columns
        jacobian = self.derivatives(fit, max(keep_columns, known))
        for _ in range(steps):
            stepped, damping = self._step(fit, jacobian, damping, tries)
            gained = (fit.cost - stepped.cost) / max(fit.cost, 1.0)
            if gained > SETTINGS.fit.converged:
                jacobian, fresh = secant(jacobian, fit, stepped), False
                fit = replace(stepped, jacobian=jacobian)
                continue
            fit = stepped
            if fresh and (fit.span > 0.0 or self._predicted_gain(fit, jacobian) < SETTINGS.fit.predicted):
                return replace(fit, converged=True)
            fit = replace(fit, span=SETTINGS.fit.wide) if fresh else fit
            jacobian, fresh, damping = self.derivatives(fit, keep_columns), True, SETTINGS.fit.least_damping
        return fit

    def _as_believed(self, fit: Fit) -> Fit:
        """The fit with the common factor on all torques as it was believed beforehand, where the data leave it open."""
        at = believed_factor(fit.hypothesis, fit.coordinates)
        mismatch = None if at is None else self.mismatch(fit.hypothesis, at)
        if at is None or mismatch is None:
            return fit
        cost = self.cost(fit.hypothesis, at, mismatch)
        return fit if cost >= fit.cost else replace(fit, coordinates=at, mismatch=mismatch, cost=cost)

    def refresh_opened(self, fit: Fit) -> Fit:
        """The fit with fresh columns of its Jacobian for the parameters that its last term opens."""
        keys = fit.hypothesis.terms[-1].opens
        jacobian = fit.jacobian.copy(order="K") if keys else fit.jacobian
        for index, unknown in enumerate(fit.hypothesis.base):
            if unknown.key in keys and index < jacobian.shape[1]:
                jacobian[:, index] = self._column(fit, index)
        return replace(fit, jacobian=jacobian)

    def derivatives(self, fit: Fit, keep_columns: int = 0) -> Array:
        """Derivative of the mismatch by each coordinate, N*m; forward differences, backward at an upper bound."""
        columns = [fit.jacobian[:, i] for i in range(min(keep_columns, fit.jacobian.shape[1]))]
        left = range(len(columns), len(fit.coordinates))
        columns += in_parallel("columns", lambda index: self._column(fit, index), left)
        return np.array(columns).T  # column by column in memory, as the normal matrix reads it

    def _column(self, fit: Fit, index: int) -> Array:
        nudged = fit.coordinates.copy()
        low, high = (float(bound[index]) for bound in fit.hypothesis.bounds)
        fine = fit.hypothesis.unknowns[index].nudge
        nudge = max(fine, min(fit.span, 0.5 * (high - low)))
        nudge = nudge if nudged[index] + nudge <= high else -nudge
        nudged[index] += nudge
        there = self.mismatch(fit.hypothesis, nudged)
        return np.zeros_like(fit.mismatch) if there is None else (there - fit.mismatch) / nudge

    def _step(self, fit: Fit, jacobian: Array, damping: float, tries: int) -> tuple[Fit, float]:
        """One damped step that lowers the cost; the fit itself when none does."""
        normal, slope = self.normal(fit, jacobian)
        for _ in range(tries):
            change = _bounded_step(normal, slope, damping, fit)
            at = fit.coordinates + change
            mismatch = self.mismatch(fit.hypothesis, at)
            if mismatch is not None:
                cost = self.cost(fit.hypothesis, at, mismatch)
                if cost < fit.cost:
                    better = replace(fit, coordinates=at, mismatch=mismatch, cost=cost, jacobian=jacobian)
                    return replace(better, converged=False), max(0.2 * damping, SETTINGS.fit.least_damping)
            damping = max(8.0 * damping, 1e-2)
        return replace(fit, jacobian=jacobian, converged=False), damping

    def _predicted_gain(self, fit: Fit, jacobian: Array) -> float:
        """The share of the cost that one step would take if the mismatch were straight along the Jacobian."""
        normal, slope = self.normal(fit, jacobian)
        change = _bounded_step(normal, slope, SETTINGS.fit.least_damping, fit)
        return -float(slope @ change + 0.5 * change @ normal @ change) / max(fit.cost, 1.0)

    def normal(self, fit: Fit, jacobian: Array) -> tuple[Array, Array]:
        """Normal matrix and slope of the cost, prior included."""
        off = np.abs(fit.mismatch) / self.weighing.scale
        weight = self.weighing.rows * np.minimum(1.0, SETTINGS.fit.huber / np.maximum(off, 1e-12))
        weight /= self.weighing.scale**2
        some = slice(jacobian.shape[1])
        centre, precision = (part[some] for part in fit.hypothesis.prior)
        normal = jacobian.T @ (weight[:, None] * jacobian) + np.diag(precision**2)
        return normal, jacobian.T @ (weight * fit.mismatch) + precision**2 * (fit.coordinates[some] - centre)


def secant(jacobian: Array, old: Fit, new: Fit) -> Array:
    """The Jacobian with the slope along the last step as it was found there."""
    step = new.coordinates - old.coordinates
    length = float(step @ step)
    if length == 0.0:
        return jacobian
    missed = new.mismatch - old.mismatch - jacobian @ step
    return np.asarray(jacobian + np.outer(step / length, missed).T)


def _bounded_step(normal: Array, slope: Array, damping: float, fit: Fit) -> Array:
    """Solve for the step; coordinates that would leave their bounds stay on them and the others are solved again."""
    low, high = fit.hypothesis.bounds
    free = np.ones(len(slope), dtype=bool)
    change = np.zeros(len(slope))
    for _ in range(len(slope)):
        some = np.flatnonzero(free)
        if len(some) == 0:
            break
        held = normal[np.ix_(some, ~free)] @ change[~free]
        diagonal = np.diag(normal)[some]
        damped = normal[np.ix_(some, some)] + np.diag(damping * diagonal + 1e-9 * max(float(diagonal.max()), 1e-12))
        change[some] = np.clip(
            -np.linalg.solve(damped, slope[some] + held), -SETTINGS.fit.longest_step, SETTINGS.fit.longest_step
        )
        inside = np.clip(fit.coordinates + change, low, high) - fit.coordinates
        out = free & (np.abs(inside - change) > 1e-12)
        change = inside
        if not out.any():
            break
        free &= ~out
    return change


def on_bound(fit: Fit) -> NDArray[np.bool_]:
    """Coordinates that lie on a bound: the data pull them further, or they do not matter."""
    low, high = fit.hypothesis.bounds
    return np.asarray(np.minimum(fit.coordinates - low, high - fit.coordinates) < SETTINGS.worth.on_bound)


def scale_of(mismatch: Array, counts: NDArray[np.bool_], floor: float) -> float:
    """Robust standard deviation of the mismatch, at least `floor` and a share of its root mean square."""
    spread = float(np.median(np.abs(mismatch[counts]))) / 0.6745
    return max(spread, SETTINGS.fit.least_of_rms * float(np.sqrt(np.mean(mismatch[counts] ** 2))), floor)


def covariance(fit: Fit, weighing: Weighing, period_s: float) -> Array:
    """Covariance of the coordinates: sandwich with correlated rows (batch means)."""
    off = fit.mismatch / weighing.scale
    weight = weighing.rows * np.minimum(1.0, SETTINGS.fit.huber / np.maximum(np.abs(off), 1e-12))
    scaled = fit.jacobian / weighing.scale
    precision = fit.hypothesis.prior[1]
    normal = scaled.T @ (weight[:, None] * scaled) + np.diag(precision**2)
    meat = long_run(scaled * (weight * off)[:, None], max(1, math.ceil(SETTINGS.fit.memory_s / period_s)))
    bread = np.linalg.pinv(normal)
    return np.asarray(bread @ (meat + np.diag(precision**2)) @ bread)


def long_run(scores: Array, rows: int) -> Array:
    """Long-run covariance of the sum of `scores`, by sums over blocks of so many rows (batch means)."""
    blocks = np.add.reduceat(scores, np.arange(0, len(scores), rows), axis=0)
    return np.asarray(blocks.T @ blocks)


# --- Narrow valleys --------------------------------------------------------------------------------------------------
# Follows a narrow valley of the cost to its bottom. Friction that grows with the torque, mass and friction of the
# model's own do nearly the same together: Gauss-Newton comes down into such a valley and stops on its floor, far from
# its lowest place, where the floor falls less than a step can tell. Along the direction of least curvature steps are
# doubled while the cost falls, all numbers are fitted again, and the way that both went is gone on (pattern move: Hooke
# and Jeeves, Journal of the ACM 8, 1961).


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
