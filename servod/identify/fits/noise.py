"""Encoder and torque-reading noise from a recording at rest."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy import stats

from servod.identify.estimate import Estimate
from servod.identify.trace import Trace


class NoiseFit(NamedTuple):
    """Standard deviations at rest: encoder in rad, torque reading in N*m."""

    encoder_rms: Estimate
    torque_reading_rms: Estimate


def fit(trace: Trace) -> NoiseFit:
    """Noise of the differences between samples, so that slow drift does not count; bounded by one count."""
    resolution = trace.settings["resolution_rad"]
    flips = np.diff(trace.position_rad)
    quiet = not np.any(flips)
    note = f"no reading changed: the noise is hidden below one count, {resolution:.2e} rad" if quiet else ""
    encoder = _deviation(flips / math.sqrt(2.0), "rad", note)
    if quiet:
        encoder = Estimate(0.0, 0.0, 0.5 * resolution, "rad", note)
    torque = _deviation(np.diff(trace.torque_actual_nm) / math.sqrt(2.0), "N*m", "")
    return NoiseFit(encoder, torque)


def _deviation(values: np.ndarray[tuple[int], np.dtype[np.float64]], unit: str, note: str) -> Estimate:
    """Standard deviation of zero-mean values, interval by chi-squared."""
    n = len(values)
    rms = float(np.sqrt(np.mean(values**2)))
    low, high = (rms * math.sqrt(n / float(stats.chi2.ppf(q, n))) for q in (0.975, 0.025))
    return Estimate(rms, low, high, unit, note)
