"""The noise of an axis model as series for the simulator: torque low-passed, encoder readings white.

Beside the simulator; the virtual plant makes the same kind of noise by itself.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from servod.axis_effects import Noise

Array = NDArray[np.float64]


def noise_series(noise: Noise | None, samples: int, period_s: float, seed: int) -> tuple[Array, Array]:
    """(torque noise in N*m, encoder reading noise in rad), a value for each sample; zeros where there is no noise."""
    if noise is None:
        return np.zeros(samples), np.zeros(samples)
    random = np.random.default_rng(seed)
    kept = math.exp(-2.0 * math.pi * noise.torque_bandwidth_hz * period_s)
    fresh = random.normal(0.0, noise.torque_rms * math.sqrt(1.0 - kept * kept), samples).tolist()
    value, torque = 0.0, []
    for push in fresh:
        value = kept * value + push
        torque.append(value)
    return np.array(torque), random.normal(0.0, noise.encoder_rms, samples)
