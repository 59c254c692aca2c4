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

from servod.errors import AnswerIsNo
from servod.identify.estimate import LEVEL, Estimate, estimate, sandwich
from servod.identify.fits import cogging
from servod.identify.fits.map_rows import rows_from
from servod.identify.trace import Trace

Array = NDArray[np.float64]

#: Knots of the spline rise by about this factor of speed; nodes of the map by about this one.
KNOT_RATIO, NODE_RATIO = 1.45, 1.25
DEGREE = 3
#: Shares for what the parts' scatter does not show: of friction, and, where friction falls with speed and nothing is
#: ever quite steady, of its change over the logarithm of speed.
ALLOWANCE, FALLING_ALLOWANCE = 0.012, 0.08
LEAST_ROWS = 20


class Side(NamedTuple):
    """The map in one direction: speed in rad/s, friction magnitude in N*m, half widths, covariance of the friction."""

    speed: Array
    friction: Array
    half_width: Array
    covariance: Array


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


def fit(traces: Sequence[Trace], inertia: float, delay_s: float, break_away_rad: float) -> MapFit:
    """Fit all slow motions at once; `break_away_rad` is static friction over stiffness. Raises AnswerIsNo."""
    rows = rows_from(traces, inertia, delay_s, break_away_rad)
    splines = [_Spline(np.abs(rows.velocity[rows.velocity * sign > 0.0]), sign) for sign in (1.0, -1.0)]
    base = np.column_stack([spline.columns(rows.velocity) for spline in splines])
    parts = len(np.unique(rows.part))
    orders = cogging.find_orders(base, rows.position, rows.torque, parts)
    design = np.column_stack([base, cogging.columns(rows.position, orders)])
    weights = np.ones(len(rows.torque))
    values: Array = np.linalg.lstsq(design, rows.torque, rcond=None)[0].astype(np.float64)
    residual = rows.torque - design @ values
    covariance = sandwich(design, residual, weights, rows.part)
    first = splines[0].size
    last = base.shape[1]
    return MapFit(
        splines[0].side(values[:first], covariance[:first, :first]),
        splines[1].side(values[first:last], covariance[first:last, first:last]),
        _harmonics(orders, values[last:], covariance[last:, last:], parts),
        float(np.sqrt(np.mean(residual**2))),
    )


class _Spline:
    """Cubic B-spline over the logarithm of speed for one direction; zero for the other."""

    def __init__(self, speed: Array, sign: float) -> None:
        if len(speed) < LEAST_ROWS:
            direction = "positive" if sign > 0.0 else "negative"
            raise AnswerIsNo(f"no steady sliding in {direction} direction: the map needs slow sines that reach it")
        self.sign = sign
        self.low, self.high = float(np.log(speed.min())), float(np.log(speed.max()))
        inner = max(1, round((self.high - self.low) / np.log(KNOT_RATIO)))
        knots = np.linspace(self.low, self.high, inner + 1)
        self._knots = np.concatenate([[self.low] * DEGREE, knots, [self.high] * DEGREE])
        self.size = len(self._knots) - DEGREE - 1

    def columns(self, velocity: Array) -> Array:
        """Design columns: signed friction of this direction."""
        here = velocity * self.sign > 0.0
        design = np.zeros((len(velocity), self.size))
        design[here] = self.sign * self._basis(np.log(np.abs(velocity[here])))
        return design

    def side(self, values: Array, covariance: Array) -> Side:
        """The map at its nodes."""
        count = max(4, round((self.high - self.low) / np.log(NODE_RATIO)) + 1)
        log_speed = np.linspace(self.low, self.high, count)
        basis = self._basis(log_speed)
        friction, spread = basis @ values, basis @ covariance @ basis.T
        factor = float(stats.norm.ppf(LEVEL))
        falling = np.maximum(-np.gradient(friction, log_speed), 0.0)
        half = np.hypot(factor * np.sqrt(np.diag(spread)), ALLOWANCE * friction)
        half = np.hypot(half, FALLING_ALLOWANCE * falling)
        return Side(np.exp(log_speed), friction, half, spread)

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
