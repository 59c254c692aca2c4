"""Bristle damping sigma1 from the joint's ringing on its bristles below break-away.

X/U = 1/(k*(1 + j*eta) + j*w*d - m*w^2): eta is the loss of the Dahl loop, the same at every frequency; d grows with it
and is sigma1 plus viscous friction. Inertia, a spring behind which a part of it is, and delay are known from the
sliding joint.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_banded
from scipy.optimize import least_squares

from servod.lab.identify.estimate import Estimate, bound_notes, estimate, jackknife, joined
from servod.lab.identify.fits.elastic import Elastic
from servod.lab.identify.trace import RecordedMotion

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

#: Images of the sampled spectrum that count, to each side.
IMAGES = 6
#: Fewer whole periods have no scatter worth the name.
LEAST_PERIODS = 3
#: Wider than this share of its value, the damping counts as not identified.
WIDEST_SHARE = 0.5
#: Share for what the periods' scatter does not show: the loop's loss is only nearly the same at every frequency.
ALLOWANCE = 0.2
#: Bounds of the search: stiffness over that at the lowest line, loss, damping over the critical one.
_RANGES = ([0.2, 0.0, 0.0], [5.0, 0.8, 5.0])


class Moved(NamedTuple):
    """What is moved, kg*m^2, and the joint with the spring that a part of it is behind; None where all is rigid."""

    inertia: float
    spring: Elastic | None = None

    def inertia_at(self, w: Array) -> Array | Complex | float:
        """Inertia that the motor's side feels at these angular frequencies; complex where the spring damps."""
        if self.spring is None:
            return self.inertia
        load, force = self.spring.load_inertia, self.spring.stiffness + 1j * w * self.spring.damping
        return self.inertia - load + load * force / (force - load * w * w)


class _Period(NamedTuple):
    """Spectra of one period at the excited lines."""

    way: Complex
    torque: Complex


def fit(trace: RecordedMotion, moved: Moved, delay_s: float, viscous: float, stiffness: float) -> Estimate | None:
    """sigma1 in N*m*s/rad; None when the recording does not tell it (coarse encoder, too little motion).

    On a bent Dahl curve the bristle moves less than the joint, by the chord's stiffness over that at zero, `stiffness`.
    """
    frequency, periods = _spectra(trace)
    if len(periods) < LEAST_PERIODS:
        return None

    def damping(parts: Sequence[_Period]) -> Array:
        chord, _, slope = _solve(frequency, parts, moved, delay_s, trace.period_s)
        return np.array([(slope - viscous) * stiffness / chord])

    values, spread = jackknife(damping, periods)
    note = _note(_searched(frequency, periods, moved, delay_s, trace.period_s)[0])
    found = estimate(float(values[0]), float(spread[0]), len(periods) - 1, "N*m*s/rad", share=ALLOWANCE, note=note)
    significant = found.value > 0.0 and found.half_width < WIDEST_SHARE * found.value
    return found if significant else None


def response(
    frequency: Array, moved: Moved, stiffness: float, loss: float, damping: float, delay_s: float, period_s: float
) -> Complex:
    """Sampled position over the held command, images of the spectrum included."""
    total = np.zeros(len(frequency), dtype=np.complex128)
    for image in range(-IMAGES, IMAGES + 1):
        w = 2.0 * np.pi * (frequency + image / period_s)
        spring = stiffness * (1.0 + 1j * loss * np.sign(w))
        joint = 1.0 / (spring + 1j * w * damping - moved.inertia_at(w) * w * w)
        total += joint * (1.0 - np.exp(-1j * w * period_s)) / (1j * w) / period_s * np.exp(-1j * w * delay_s)
    return total


def _spectra(trace: RecordedMotion) -> tuple[Array, list[_Period]]:
    """Lines in Hz, and the spectra of all whole periods but the first."""
    s = trace.settings
    count = int(s["count"])
    lines = np.array([int(s[f"line_{i}"]) for i in range(sum(key.startswith("line_") for key in s))])
    periods = []
    for i in range(1, int(s["periods"])):
        cut = slice(i * count, (i + 1) * count)
        if len(trace) < (i + 1) * count:
            break
        way = trace.position_rad[cut]
        way = way - np.linspace(0.0, 1.0, count) * (way[-1] - way[0])
        periods.append(_Period(np.fft.rfft(way)[lines], np.fft.rfft(trace.torque_nm[cut])[lines]))
    return lines / (count * trace.period_s), periods


def _solve(frequency: Array, periods: Sequence[_Period], moved: Moved, delay_s: float, period_s: float) -> Array:
    """(stiffness, loss, damping) that fit the periods' mean response."""
    (chord, loss, damping), first, critical = _searched(frequency, periods, moved, delay_s, period_s)
    return np.array([first * chord, loss, critical * damping])


def _note(x: Array) -> str:
    """What of the search stands at the end of its range."""
    names = ("the chord's stiffness", "the loop's loss", "the damping")
    return joined(
        *(f"{name} {note}" for name, note in zip(names, bound_notes(x.tolist(), *_RANGES), strict=True) if note)
    )


def _searched(
    frequency: Array, periods: Sequence[_Period], moved: Moved, delay_s: float, period_s: float
) -> tuple[Array, float, float]:
    """(stiffness, loss, damping) as the search has them, and the units of stiffness and damping."""
    measured = np.asarray(sum(p.way for p in periods) / sum(p.torque for p in periods))
    first = float(1.0 / np.abs(measured[0]))
    critical = 2.0 * np.sqrt(first * moved.inertia)

    def misfit(x: Array) -> Array:
        model = response(frequency, moved, first * x[0], x[1], critical * x[2], delay_s, period_s)
        error = (model - measured) * first
        return np.concatenate([error.real, error.imag])

    return least_squares(misfit, [1.0, 0.05, 0.5], bounds=_RANGES).x, first, float(critical)


# --- The bristle over its way ----------------------------------------------------------------------------------------
# Friction that follows its steady curve over a way: the LuGre bristle along a recorded motion, linear in the curve. Of
# dz/dt = v - s0*|v|/g(v)*z follows, over the way s, d(s0*z)/ds = (sign(v)*g(v) - s0*z)/L with L = g/s0: the bristle's
# force is the steady curve behind a first-order low-pass over way. Given L, which an earlier fit knows well enough, it
# is linear in g (the paper's (1), (7) and (18)).


class Bristle(NamedTuple):
    """What the map must know of the bristles: stiffness N*m/rad, damping N*m*s/rad, mean break-away N*m."""

    stiffness: float
    damping: float
    break_away_nm: float

    @property
    def way_rad(self) -> float:
        """Way of the bristles until the joint slides."""
        return self.break_away_nm / self.stiffness


def follow(target: Array, way: Array, length: Array) -> Array:
    """Columns of `target` (rows of one motion) behind the low-pass: `way` from row to row, `length` L at each row.

    Begins at the first row's target.
    """
    kept = np.exp(-way / length)
    kept[0] = 0.0
    diagonals = np.vstack([np.ones(len(way)), np.append(-kept[1:], 0.0)])
    followed: Array = solve_banded((1, 0), diagonals, (1.0 - kept)[:, None] * target)
    return followed


def dry_columns(target: Array, velocity: Array, way: Array, length: Array, bristle: Bristle) -> Array:
    """Bristle force s0*z + s1*dz/dt for every column of `target`, the steady signed curve's basis."""
    spring = follow(target, way, length)
    rate = np.abs(velocity) / length * (bristle.damping / bristle.stiffness)
    force: Array = spring + rate[:, None] * (target - spring)
    return force
