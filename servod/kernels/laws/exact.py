"""Exact step of the friction state: what explicit Euler gets wrong at 1 ms, where the decay reaches 10 000 1/s.

Stands under the friction laws. Plain floats, compiled as it is by numba.
"""

from __future__ import annotations

import math

SMALL_EXPONENT = 1e-9  # below it 1 - exp(-a*dt) equals a*dt to the last bit


def decayed(z: float, decay_per_s: float, drive_rad_s: float, dt: float) -> float:
    """Solution after `dt` of z' = -a*z + drive, with a and drive held: equations (5), (9) and (18) within one cycle.

    z(dt) = z*exp(-a*dt) + drive*(1 - exp(-a*dt))/a, and z + drive*dt for a = 0. `z` in rad, `drive_rad_s` in rad/s.
    """
    exponent = decay_per_s * dt
    if exponent < SMALL_EXPONENT:
        return z + drive_rad_s * dt
    gone = -math.expm1(-exponent)
    return z + (drive_rad_s / decay_per_s - z) * gone


def limited(value: float, bound: float) -> float:
    """`value` within +-`bound`; NaN stays NaN, so that the limits see it."""
    if value > bound:
        return bound
    if value < -bound:
        return -bound
    return value
