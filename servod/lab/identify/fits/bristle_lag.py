"""Friction that follows its steady curve over a way: the LuGre bristle along a recorded motion, linear in the curve.

Under the friction map. Of dz/dt = v - s0*|v|/g(v)*z follows, over the way s, d(s0*z)/ds = (sign(v)*g(v) - s0*z)/L with
L = g/s0: the bristle's force is the steady curve behind a first-order low-pass over way. Given L, which an earlier fit
knows well enough, it is linear in g (the paper's (1), (7) and (18)).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_banded

Array = NDArray[np.float64]


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
