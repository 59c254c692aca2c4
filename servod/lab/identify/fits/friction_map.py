"""Friction-velocity map per direction with 95 % intervals, torque periodic in position fitted jointly (Fig. 8).

One linear regression: a cubic spline over the logarithm of speed for each direction, and a sine for each cogging order.
Intervals by the cluster-robust sandwich over parts of strokes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.interpolate import BSpline

from servod.common.errors import AnswerIsNo
from servod.lab.identify.estimate import LEVEL, Estimate, estimate, sandwich
from servod.lab.identify.fits import cogging
from servod.lab.identify.fits.bristle import Bristle, dry_columns, follow
from servod.lab.identify.fits.map_rows import Motion, coarse_rad_s, motions_from, slowest_rad_s
from servod.lab.identify.trace import Trace

Array = NDArray[np.float64]

#: Knots of the spline rise by about this factor of speed; nodes of the map by about this one.
KNOT_RATIO, NODE_RATIO = 1.45, 1.25
DEGREE = 3
#: Shares for what the parts' scatter does not show: of friction, and, where friction falls with speed and nothing is
#: ever quite steady, of its change over the logarithm of speed.
ALLOWANCE, FALLING_ALLOWANCE = 0.012, 0.08
#: And of friction at the speed of the encoder's steps (`map_rows.coarse_rad_s`), falling with speed.
COARSE_ALLOWANCE = 0.03
#: Half width of a 95 % interval over the standard deviation, from many parts of strokes.
_FACTOR = float(stats.norm.ppf(LEVEL))
LEAST_ROWS = 20
#: Fits, each with the map of the one before: how far bristles reach changes little.
ROUNDS = 3
#: Bristles bent to this share of what steady sliding bends them count as settled.
SETTLED = 0.95
#: Cogging is looked for in every so many-th row.
SEARCH_STEP = 4
#: The bristles reach at least this share of their way at break-away.
LEAST_LENGTH = 0.2
#: Weight of the spline's second differences against one row of data.
STIFFENING = 2.0


class Side(NamedTuple):
    """The map in one direction: speed in rad/s, friction magnitude in N*m, half widths, covariance of the friction."""

    speed: Array
    friction: Array
    half_width: Array
    covariance: Array

    @property
    def unseen(self) -> Array:
        """The part of the half width that stands for what no scatter shows, in N*m."""
        seen = _FACTOR**2 * np.diag(self.covariance)
        allowance: Array = np.sqrt(np.maximum(self.half_width**2 - seen, 0.0))
        return allowance


class Harmonic(NamedTuple):
    """One sine of torque over position: resisting torque amplitude*sin(order*x + phase), N*m and rad."""

    order: int
    amplitude: Estimate
    phase: float


class MapFit(NamedTuple):
    """Map of both directions, cogging, and the residual's standard deviation in N*m."""

    positive: Side
    negative: Side
    cogging: tuple[Harmonic, ...]
    residual_rms: float


def fit(traces: Sequence[Trace], inertia: float, delay_s: float, bristle: Bristle) -> MapFit:
    """Fit all slow motions at once, each time with what the fit before says of bristles and viscous friction.

    Raises AnswerIsNo where a direction never slides.
    """
    motions = motions_from(traces, inertia, delay_s)
    speeds = (slowest_rad_s(traces), coarse_rad_s(traces))
    prior, orders = _Prior(bristle, None), None
    for _ in range(ROUNDS):
        found, orders = _fit(motions, speeds, prior, orders)
        prior = _Prior(bristle, found)
    return found


class _Prior:
    """What is known of the map before a fit: how far the bristles reach, and the viscous part."""

    def __init__(self, bristle: Bristle, found: MapFit | None) -> None:
        self.bristle, self._found = bristle, found
        sides = [found.positive, found.negative] if found is not None else []
        self.viscous = max(0.0, min((_top_slope(side) for side in sides), default=0.0))

    def length(self, velocity: Array) -> Array:
        """L of the bristle at each velocity, in rad."""
        if self._found is None:
            return np.full(len(velocity), self.bristle.way_rad)
        speed = np.abs(velocity)
        plus, minus = (
            np.interp(speed, side.speed, side.friction - self.viscous * side.speed)
            for side in (self._found.positive, self._found.negative)
        )
        least = LEAST_LENGTH * self.bristle.way_rad
        length: Array = np.maximum(np.where(velocity > 0.0, plus, minus) / self.bristle.stiffness, least)
        return length


def _top_slope(side: Side) -> float:
    """Slope of the map over its upper half of speed."""
    upper = side.speed > 0.5 * side.speed[-1]
    return float(np.polyfit(side.speed[upper], side.friction[upper], 1)[0]) if np.count_nonzero(upper) > 1 else 0.0


def _fit(
    motions: Sequence[Motion], speeds: tuple[float, float], prior: _Prior, orders: list[int] | None
) -> tuple[MapFit, list[int]]:
    """One round; cogging's `orders` are looked for where they are not given.

    `speeds`: the slowest of the map, and the one at which the encoder's steps tell.
    """
    settled = [_settled(motion, speeds[0], prior) for motion in motions]
    velocity, position, torque, part, smear, weight = (
        np.concatenate([getattr(m, name)[kept] for m, kept in zip(motions, settled, strict=True)])
        for name in ("velocity", "position", "torque", "part", "smear", "weight")
    )
    torque = torque - prior.viscous * velocity
    splines = [_Spline(np.abs(velocity[velocity * sign > 0.0]), sign, *speeds) for sign in (1.0, -1.0)]
    base = np.concatenate([_dry(m, splines, prior)[kept] for m, kept in zip(motions, settled, strict=True)])
    parts = len(np.unique(part))
    if orders is None:
        few = slice(None, None, SEARCH_STEP)
        orders = cogging.find_orders(base[few], position[few], torque[few], parts)
    design = np.column_stack([base, cogging.columns(position, orders, smear)])
    ridge = _stiffeners(splines, design.shape[1])
    values, covariance, residual = _regress(design, torque, part, weight, ridge)
    first, last = splines[0].size, base.shape[1]
    found = MapFit(
        splines[0].side(values[:first], covariance[:first, :first], prior.viscous),
        splines[1].side(values[first:last], covariance[first:last, first:last], prior.viscous),
        _harmonics(orders, values[last:], covariance[last:, last:], parts),
        float(np.sqrt(np.mean(residual**2))),
    )
    return found, orders


def _regress(
    design: Array, torque: Array, part: NDArray[np.int64], weight: Array, ridge: Array
) -> tuple[Array, Array, Array]:
    """Values, cluster-robust covariance and residual of the weighted regression, `ridge` rows beside the data."""
    full = np.concatenate([design, ridge])
    target = np.concatenate([torque, np.zeros(len(ridge))])
    weights = np.concatenate([weight, np.ones(len(ridge))])
    root = np.sqrt(weights)
    values: Array = np.linalg.lstsq(full * root[:, None], target * root, rcond=None)[0].astype(np.float64)
    residual = target - full @ values
    clusters = np.concatenate([part, part.max() + 1 + np.arange(len(ridge))])
    residual[len(torque) :] = 0.0
    return values, sandwich(full, residual, weights, clusters), residual[: len(torque)]


def _settled(motion: Motion, slowest: float, prior: _Prior) -> NDArray[np.bool_]:
    """Rows that are on the map and whose bristles are bent as they are in steady sliding."""
    sign = np.sign(motion.velocity)
    bent = follow(sign[:, None], motion.way, prior.length(motion.velocity))[:, 0]
    settled: NDArray[np.bool_] = (sign * bent > SETTLED) & (np.abs(motion.velocity) > slowest)
    settled &= np.arange(len(settled)) % motion.spacing == 0
    return settled


def _dry(motion: Motion, splines: Sequence[_Spline], prior: _Prior) -> Array:
    """Design columns of one motion, behind the bristles."""
    steady = np.column_stack([spline.columns(motion.velocity) for spline in splines])
    length = prior.length(motion.velocity)
    return dry_columns(steady, motion.velocity, motion.way, length, prior.bristle)


def _stiffeners(splines: Sequence[_Spline], width: int) -> Array:
    """Rows that hold the spline's bends small where no data do."""
    rows, first = [], 0
    for spline in splines:
        bends = np.diff(np.eye(spline.size), 2, axis=0)
        rows.append(np.pad(bends, ((0, 0), (first, width - first - spline.size))))
        first += spline.size
    return STIFFENING * np.concatenate(rows)


class _Spline:
    """Cubic B-spline over the logarithm of speed for one direction; zero for the other."""

    def __init__(self, speed: Array, sign: float, slowest: float, coarse_rad_s: float) -> None:
        if len(speed) < LEAST_ROWS:
            direction = "positive" if sign > 0.0 else "negative"
            raise AnswerIsNo(f"no steady sliding in {direction} direction: the map needs slow sines that reach it")
        self.sign, self._coarse_rad_s = sign, coarse_rad_s
        self.low, self.high = float(np.log(slowest)), float(np.log(speed.max()))
        inner = max(1, round((self.high - self.low) / np.log(KNOT_RATIO)))
        knots = np.linspace(self.low, self.high, inner + 1)
        self._knots = np.concatenate([[self.low] * DEGREE, knots, [self.high] * DEGREE])
        self.size = len(self._knots) - DEGREE - 1

    def columns(self, velocity: Array) -> Array:
        """Design columns: signed friction of this direction."""
        here = velocity * self.sign > 0.0
        design = np.zeros((len(velocity), self.size))
        design[here] = self.sign * self._basis(np.log(np.maximum(np.abs(velocity[here]), 1e-12)))
        return design

    def side(self, values: Array, covariance: Array, viscous: float) -> Side:
        """The map at its nodes; `viscous` friction comes on top of the spline."""
        count = max(4, round((self.high - self.low) / np.log(NODE_RATIO)) + 1)
        log_speed = np.linspace(self.low, self.high, count)
        basis = self._basis(log_speed)
        speed, spread = np.exp(log_speed), basis @ covariance @ basis.T
        friction = basis @ values + viscous * speed
        falling = np.maximum(-np.gradient(friction, log_speed), 0.0)
        half = np.hypot(_FACTOR * np.sqrt(np.diag(spread)), ALLOWANCE * friction)
        half = np.hypot(half, FALLING_ALLOWANCE * falling)
        half = np.hypot(half, COARSE_ALLOWANCE * self._coarse_rad_s / speed * friction)
        return Side(speed, friction, half, spread)

    def _basis(self, log_speed: Array) -> Array:
        inside = np.clip(log_speed, self.low, self.high - 1e-9)
        matrix: Array = BSpline.design_matrix(inside, self._knots, DEGREE).toarray()
        return matrix


def _harmonics(orders: list[int], values: Array, covariance: Array, parts: int) -> tuple[Harmonic, ...]:
    """Amplitude and phase of every order: a*sin(nx) + b*cos(nx)."""
    waves = []
    for i, order in enumerate(orders):
        a, b = values[2 * i : 2 * i + 2]
        amplitude = float(np.hypot(a, b))
        along = np.array([a, b]) / amplitude
        variance = float(along @ covariance[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] @ along)
        size = estimate(amplitude, float(np.sqrt(variance)), parts, "N*m", share=0.03)
        waves.append(Harmonic(order, size, float(np.arctan2(b, a))))
    return tuple(waves)
