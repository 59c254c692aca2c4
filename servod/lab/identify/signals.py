"""Recorded signals made ready for regressions: torque shifted by the delay, position smoothed and differentiated.

Under the fits. Torque and position pass the same Gaussian kernel, so that a linear equation between them stays true.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import convolve1d

Array = NDArray[np.float64]

#: The kernel reaches this many standard deviations to each side.
REACH = 4.0


class Smooth(NamedTuple):
    """Smoothed signals of one motion, on its own time steps; the ends, where the kernel has no data, are cut."""

    t_s: Array
    torque: Array
    position: Array
    velocity: Array
    acceleration: Array


def acting_torque(torque: Array, delay_s: float, period_s: float) -> Array:
    """Torque that acts, averaged over each period centred on its sample, of commands held for a period each.

    A command of sample k acts from t_k + delay for one period; before the first, the first is taken.
    """
    shift = delay_s / period_s + 0.5
    whole = int(np.floor(shift))
    part = shift - whole
    padded = np.concatenate([np.full(whole + 1, torque[0]), torque])
    count = len(torque)
    new, old = padded[1 : 1 + count], padded[:count]
    blended: Array = (1.0 - part) * new + part * old
    return blended


def smooth(t_s: Array, torque: Array, position: Array, delay_s: float, width_s: float) -> Smooth:
    """Torque at the joint, position and its derivatives through a Gaussian of standard deviation `width_s`."""
    period = float(np.median(np.diff(t_s)))
    half = max(2, int(np.ceil(REACH * width_s / period)))
    k = np.arange(-half, half + 1) * period
    kernel = np.exp(-0.5 * (k / width_s) ** 2)
    kernel /= kernel.sum()
    slope = kernel * k  # least-squares exact on lines and parabolas, up to the discrete moments
    slope /= np.sum(slope * k)
    bend = kernel * (k**2 - np.sum(kernel * k**2))
    bend *= 2.0 / np.sum(bend * k**2)
    acting = acting_torque(torque, delay_s, period)
    inside = slice(half, len(t_s) - half)
    filtered = (convolve1d(s, kernel[::-1]) for s in (acting, position))
    derivatives = (convolve1d(position, kern[::-1]) for kern in (slope, bend))
    return Smooth(t_s[inside], *(s[inside] for s in filtered), *(s[inside] for s in derivatives))
