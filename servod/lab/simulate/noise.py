"""The noise of an axis model as series for the simulator: torque low-passed, encoder readings white.

Beside the simulator; the virtual plant makes the same kind of noise by itself.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from servod.formats.model.axis_model import AxisModel
from servod.formats.model.effects import Noise

Array = NDArray[np.float64]

#: Bandwidth of the torque noise that an identification measures while the joint slides.
IDENTIFIED_HZ = 40.0


def noise_of(model: AxisModel, resolution_rad: float = 0.0) -> Noise | None:
    """The model's own noise, or what its identification measured; None where nobody says anything of it.

    What was measured at rest has the rounding to encoder counts in it: a simulation that rounds to `resolution_rad`
    by itself gets the rest. The torque noise was measured while sliding, beside the cogging that was found: an upper
    bound.
    """
    if model.noise is not None or model.identified is None:
        return model.noise
    known = model.identified.values
    torque, encoder = known.get("torque_noise_rms"), known.get("encoder_noise_rms")
    return Noise(
        torque_rms=torque.value if torque else 0.0,
        torque_bandwidth_hz=IDENTIFIED_HZ,
        encoder_rms=math.sqrt(max(encoder.value**2 - resolution_rad**2 / 12.0, 0.0)) if encoder else 0.0,
    )


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
