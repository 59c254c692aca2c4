"""Encoder and torque-reading noise from a recording at rest.

A reading is rounded to counts. How much of its noise that hides or adds depends on where within a count the joint
stands, which nobody knows: the interval of the encoder's noise spans every place.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from servod.lab.identify.estimate import LEVEL, Estimate
from servod.lab.identify.trace import Trace

Array = NDArray[np.float64]

#: Parts of the recording whose scatter makes the interval: neighbouring differences share a sample, and whatever colour
#: the noise has, tenths of a second do not.
PARTS = 15
#: So many events may be expected where none was seen (Poisson, one-sided at LEVEL).
UNSEEN_EVENTS = -math.log(1.0 - LEVEL)
#: Noise in counts up to which the place within a count matters; beyond, rounding adds its 1/12 everywhere.
WIDEST_COUNTS, ROUNDING = 1.5, 1.0 / 12.0
_GRID = np.linspace(1e-4, WIDEST_COUNTS, 301)


class NoiseFit(NamedTuple):
    """Standard deviations at rest: encoder in rad, torque reading in N*m."""

    encoder_rms: Estimate
    torque_reading_rms: Estimate


class _Variance(NamedTuple):
    """A variance with its 95 % interval."""

    value: float
    low: float
    high: float


def fit(trace: Trace) -> NoiseFit:
    """Noise of the differences between samples, so that slow drift does not count.

    The encoder's value is that of its readings, rounding included; its interval begins at the least that the noise
    alone can be, and holds both.
    """
    encoder = _encoder(_variance(trace.position_rad), len(trace), trace.settings["resolution_rad"])
    torque = _variance(trace.torque_actual_nm)
    note = "" if torque.value > 0.0 else "no reading changed: the noise is hidden below the drive's step"
    value, low, high = (math.sqrt(part) for part in torque)
    return NoiseFit(encoder, Estimate(value, low, high, "N*m", note))


def beside_rounding(low: float, high: float) -> tuple[float, float]:
    """Least and largest deviation of noise, in counts, whose rounded readings have a variance of `low` to `high`.

    Over every place within a count: midway between two, readings of next to no noise differ by a count already; in the
    middle of one, much of it shows nothing.
    """
    least = 0.0 if low <= _rounded_variance(0.5)[0] else _inverse(low, _rounded_variance(0.5))
    return least, _inverse(high, _rounded_variance(0.0))


def _encoder(seen: _Variance, samples: int, resolution_rad: float) -> Estimate:
    """RMS of the readings, and the interval that holds it and the noise beside rounding."""
    count = resolution_rad**2
    # few changes of the reading scatter too little to say how many there might have been
    most = max(seen.high, UNSEEN_EVENTS * count / samples)
    low, high = (resolution_rad * part for part in beside_rounding(seen.low / count, most / count))
    note = (
        f"rounding to counts of {resolution_rad:.2e} rad is in it; the noise beside it is {low:.2g} to {high:.2g} rad"
    )
    if seen.value == 0.0:
        note = f"no reading changed: the noise is hidden below one count, {resolution_rad:.2e} rad"
    elif seen.value > WIDEST_COUNTS**2 * count:
        note = ""
    return Estimate(math.sqrt(seen.value), low, max(high, math.sqrt(seen.high)), "rad", note)


def _variance(readings: Array) -> _Variance:
    """Half the mean square of the differences, interval by the scatter of parts."""
    squares = 0.5 * np.diff(readings) ** 2
    means = np.array([part.mean() for part in np.array_split(squares, PARTS)])
    half = float(stats.t.ppf(LEVEL, PARTS - 1) * means.std(ddof=1)) / math.sqrt(PARTS)
    value = float(squares.mean())
    return _Variance(value, max(0.0, value - half), value + half)


def _rounded_variance(place: float) -> Array:
    """Variance of readings over `_GRID`, counts^2, of noise about a joint `place` off the middle of a count."""
    counts = np.arange(-12, 13)
    edges = np.append(counts - 0.5, counts[-1] + 0.5) - place
    shares = np.diff(stats.norm.cdf(edges[None, :] / _GRID[:, None]), axis=1)
    variance: Array = shares @ counts**2 - (shares @ counts) ** 2
    return variance


def _inverse(variance: float, over_grid: Array) -> float:
    """Deviation of the noise, in counts, whose readings have this variance."""
    if variance >= over_grid[-1]:
        return math.sqrt(variance - ROUNDING)
    return float(np.interp(variance, over_grid, _GRID))
