"""The region of poles that decay and damping ask for, as the one disc that an LMI can hold.

Stands under the LMIs. The set |z| <= rho, |z| <= exp(-zeta/sqrt(1 - zeta^2)*|arg z|) is not convex; the largest disc in
it that touches rho on the real axis is an inner approximation, so what the disc proves also holds for the set.
"""

from __future__ import annotations

import math

import numpy as np

STEPS = 40
#: Speeds between which the regions' gains blend [rad/s]: below the fall of the Stribeck curve of the paper's joint.
OVERLAP_RAD_S = (0.005, 0.02)


def pole_disc(least_decay_per_s: float, least_damping: float, period_s: float) -> tuple[float, float]:
    """(centre, radius) of the disc for a decay of at least `least_decay_per_s` and a damping ratio of at least that."""
    rho = math.exp(-least_decay_per_s * period_s)
    spiral = least_damping / math.sqrt(1.0 - least_damping**2)
    circle = np.exp(1j * np.linspace(0.0, math.pi, 721))
    low, high = 0.0, rho
    for _ in range(STEPS):
        radius = 0.5 * (low + high)
        z = rho - radius + radius * circle
        inside = bool(np.all(np.abs(z) <= np.exp(-spiral * np.abs(np.angle(z))) + 1e-12))
        low, high = (radius, high) if inside else (low, radius)
    return rho - low, low
