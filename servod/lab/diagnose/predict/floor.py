"""The noise floor of the mismatch, from the quietest stretches of the recordings.

Stands between the predictor and every statement about how much could be explained. Physics that is missing acts here
and there, noise everywhere: the quieter stretches show it, corrected for having been picked as quiet. Where physics is
missing everywhere, the ripple from row to row bounds the noise: what the observer shows of physics is smooth.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from servod.lab.diagnose.predict.predict import Predictor
from servod.lab.diagnose.settings import SETTINGS

Array = NDArray[np.float64]


def noise_floor(predictor: Predictor, mismatch: Array) -> float:
    """Mean square of the noise in the mismatch, (N*m)^2: the mean over the recordings."""
    parts = [trace_floor(predictor, index, mismatch) for index in range(len(predictor.traces))]
    return float(np.mean(parts))


def above_noise(error: float, floor: float) -> float:
    """What of a mean square lies above the floor; the least that a floor, itself an estimate, can tell from none."""
    return max(error - floor, SETTINGS.floor.least_share * error, 1e-30)


def trace_floor(predictor: Predictor, index: int, mismatch: Array) -> float:
    """Mean square of the noise in one recording's mismatch."""
    part, trace = predictor.slices[index], predictor.traces[index]
    values = mismatch[part][predictor.counts[part]]
    rows = max(8, round(SETTINGS.floor.stretch / (predictor.rate * trace.period_s)))
    count = len(values) // rows
    if count < 4:
        return float(np.mean(values**2)) if len(values) else 0.0
    powers = np.mean(values[: count * rows].reshape(count, rows) ** 2, axis=1)
    spread = math.sqrt(2.0 / rows)
    quiet = float(np.quantile(powers, SETTINGS.floor.quantile)) / max(1.0 + SETTINGS.floor.score * spread, 0.3)
    return min(quiet, SETTINGS.floor.slow_over_white * white_power(values))


def white_power(values: Array) -> float:
    """Mean square of the white part of a series, from its second differences; robust against steps in it."""
    bends = np.abs(np.diff(values, 2))
    return float(np.median(bends) / 0.6745) ** 2 / 6.0


def stretch_means(predictor: Predictor, mismatch: Array) -> Array:
    """Means of the mismatch over short stretches of all recordings, N*m."""
    means = []
    for part, trace in zip(predictor.slices, predictor.traces, strict=True):
        rows = max(8, round(SETTINGS.floor.stretch / (predictor.rate * trace.period_s)))
        count = len(mismatch[part]) // rows
        means.append(mismatch[part][: count * rows].reshape(count, rows).mean(axis=1))
    return np.concatenate(means)
