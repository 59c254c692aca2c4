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
from servod.lab.identify.trace import RecordedMotion, Smooth, smooth

# --- Slow motions ----------------------------------------------------------------------------------------------------
# Slow motions made ready for the friction map: smoothed, inertia taken off, cut into parts.


#: Smoothing of torque and motion: s at the finest, and so many counts' worth of time for a coarse encoder.
NARROWEST_S, WIDEST_S, WIDTH_S_PER_RAD = 0.0015, 0.0035, 110.0
#: Rows further apart than so many widths of the smoothing say something new.
SPACING = 2.0
#: Smoothing of the velocity where nothing says that it changes more quickly.
CALM_S = 0.03
#: What the encoder's steps may make of the quick velocity, in counts over the smoothing.
QUICK_COUNTS = 0.3
#: Slower than this share of the slowest motion's peak, or than so many counts per second, is not on the map.
SLOWEST_SHARE, SLOWEST_COUNTS_PER_S = 0.4, 70.0
#: A joint follows its reference when its velocity is off by less than this share and so much more. Where it sticks and
#: slips, torque noise has chosen the moment, and the friction seen in between is biased: such rows weigh little.
FOLLOWS_SHARE, FOLLOWS_RAD_S, ASTRAY_WEIGHT = 0.4, 0.004, 0.01
#: Each stroke counts as this many independent parts.
PARTS = 3


class Stroke(NamedTuple):
    """One motion on an even grid: velocity rad/s, position rad, friction plus cogging N*m, and its part's number.

    `way` is the distance from the row before, `smear` the way that the smoothing of torque takes in (one standard
    deviation), `weight` is less where the joint sticks and slips.
    """

    velocity: Array
    position: Array
    torque: Array
    part: NDArray[np.int64]
    way: Array
    smear: Array
    weight: Array
    spacing: int  # rows between two that say something new


def motions_from(traces: Sequence[RecordedMotion], inertia: float, delay_s: float) -> list[Stroke]:
    """All motions; parts are numbered through."""
    motions, parts = [], 0
    for trace in traces:
        motion = _motion(trace, inertia, delay_s)
        motions.append(motion._replace(part=motion.part + parts))
        parts += int(motion.part.max(initial=-1)) + 1
    return motions


def slowest_rad_s(traces: Sequence[RecordedMotion]) -> float:
    """The lowest speed that the recordings can tell."""
    return max(SLOWEST_SHARE * min(t.settings["peak_rad_s"] for t in traces), coarse_rad_s(traces))


def coarse_rad_s(traces: Sequence[RecordedMotion]) -> float:
    """The speed at which the encoder's steps begin to hide the motion."""
    return SLOWEST_COUNTS_PER_S * max(t.settings["resolution_rad"] for t in traces)


def _motion(trace: RecordedMotion, inertia: float, delay_s: float) -> Stroke:
    resolution = trace.settings["resolution_rad"]
    width = float(np.clip(WIDTH_S_PER_RAD * resolution, NARROWEST_S, WIDEST_S))
    calm = smooth(trace.t_s, trace.torque_nm, trace.position_rad, delay_s, CALM_S)
    quick = smooth(trace.t_s, trace.torque_nm, trace.position_rad, delay_s, width)
    step = max(1, round(0.5 * width / trace.period_s))
    grid = np.arange(np.searchsorted(quick.t_s, calm.t_s[0]), len(quick.t_s), step)
    grid = grid[quick.t_s[grid] <= calm.t_s[-1]]
    velocity = _velocity(quick.velocity[grid], np.interp(quick.t_s[grid], calm.t_s, calm.velocity), resolution, width)
    part = np.interp(quick.t_s[grid], calm.t_s, _parts(calm)).round().astype(np.int64)
    torque = quick.torque[grid] - inertia * quick.acceleration[grid]
    wanted = np.gradient(trace.reference_rad, trace.period_s)
    weight = _weight(velocity, np.interp(quick.t_s[grid], trace.t_s, wanted))
    spacing = max(1, round(SPACING * width / (step * trace.period_s)))
    way = np.abs(velocity) * step * trace.period_s
    return Stroke(velocity, quick.position[grid], torque, part, way, np.abs(velocity) * width, weight, spacing)


def _weight(velocity: Array, wanted: Array) -> Array:
    """1 where the joint follows its reference, less where it sticks and slips."""
    off = np.abs(velocity - wanted) > FOLLOWS_SHARE * np.abs(wanted) + FOLLOWS_RAD_S
    weight: Array = np.where(off, ASTRAY_WEIGHT, 1.0)
    return weight


def _velocity(quick: Array, calm: Array, resolution: float, width_s: float) -> Array:
    """The calm velocity, and the quick one where it is off it by more than encoder steps make."""
    noise = QUICK_COUNTS * resolution / width_s
    chosen: Array = np.where(np.abs(quick - calm) > noise, quick, calm)
    return chosen


def _parts(s: Smooth) -> NDArray[np.int64]:
    """Number of the part of a stroke that each row belongs to."""
    turned = np.flatnonzero(np.diff(np.sign(s.velocity)) != 0.0) + 1
    stroke = np.zeros(len(s.velocity), dtype=np.int64)
    stroke[turned] = 1
    stroke = np.cumsum(stroke)
    counts = np.bincount(stroke)
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    progress = (np.arange(len(stroke)) - starts[stroke]) / counts[stroke]
    part: NDArray[np.int64] = PARTS * stroke + np.minimum((PARTS * progress).astype(np.int64), PARTS - 1)
    return part


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


class FittedHarmonic(NamedTuple):
    """One sine of torque over position: resisting torque amplitude*sin(order*x + phase), N*m and rad."""

    order: int
    amplitude: Estimate
    phase: float


class MapFit(NamedTuple):
    """Map of both directions, cogging, and the residual's standard deviation in N*m."""

    positive: Side
    negative: Side
    cogging: tuple[FittedHarmonic, ...]
    residual_rms: float


def fit(traces: Sequence[RecordedMotion], inertia: float, delay_s: float, bristle: Bristle) -> MapFit:
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
    motions: Sequence[Stroke], speeds: tuple[float, float], prior: _Prior, orders: list[int] | None
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


def _settled(motion: Stroke, slowest: float, prior: _Prior) -> NDArray[np.bool_]:
    """Rows that are on the map and whose bristles are bent as they are in steady sliding."""
    sign = np.sign(motion.velocity)
    bent = follow(sign[:, None], motion.way, prior.length(motion.velocity))[:, 0]
    settled: NDArray[np.bool_] = (sign * bent > SETTLED) & (np.abs(motion.velocity) > slowest)
    settled &= np.arange(len(settled)) % motion.spacing == 0
    return settled


def _dry(motion: Stroke, splines: Sequence[_Spline], prior: _Prior) -> Array:
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


def _harmonics(orders: list[int], values: Array, covariance: Array, parts: int) -> tuple[FittedHarmonic, ...]:
    """Amplitude and phase of every order: a*sin(nx) + b*cos(nx)."""
    waves = []
    for i, order in enumerate(orders):
        a, b = values[2 * i : 2 * i + 2]
        amplitude = float(np.hypot(a, b))
        along = np.array([a, b]) / amplitude
        variance = float(along @ covariance[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] @ along)
        size = estimate(amplitude, float(np.sqrt(variance)), parts, "N*m", share=0.03)
        waves.append(FittedHarmonic(order, size, float(np.arctan2(b, a))))
    return tuple(waves)
