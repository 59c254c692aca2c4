"""Stribeck parameters of each direction from the friction map, for people and for designs that want numbers.

F(v) = F_C + (F_S - F_C)*exp(-(v/v_s)^n) + F_v*v, the paper's (18) with its exponent free. The map itself stays the
model.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.optimize import least_squares

from servod.lab.identify.estimate import LEVEL, Estimate, bound_notes, estimate
from servod.lab.identify.fits.friction_map import Side

Array = NDArray[np.float64]

#: Range of the exponent; at its ends the result says so.
EXPONENT = (0.5, 4.0)
#: Where the search for the Stribeck velocity begins, as shares of the map's range of log speed.
STARTS = np.array([0.3, 0.5, 0.7, 0.85])
#: Static friction is the curve's end at no speed, slower than anything that was measured.
SLOWEST_ALLOWANCE = 0.03
#: Misfit that every node is allowed, as a share of friction.
SHARE = 0.003


class CurveFit(NamedTuple):
    """Parameters of one direction."""

    coulomb: Estimate
    static: Estimate
    stribeck_velocity: Estimate
    exponent: Estimate
    viscous: Estimate


def friction(values: Array, speed: Array) -> Array:
    """Friction magnitude of (F_C, F_S - F_C, log v_s, n, F_v)."""
    coulomb, extra, log_speed, exponent, viscous = values
    curve: Array = coulomb + extra * np.exp(-((speed / np.exp(log_speed)) ** exponent)) + viscous * speed
    return curve


def fit(side: Side) -> CurveFit:
    """Weighted least squares over the map's nodes; intervals through the map's own covariance and its allowances."""
    weight = 1.0 / np.hypot(np.sqrt(np.diag(side.covariance)), SHARE * side.friction)
    top = float(side.friction.max())
    low = np.array([0.0, 0.0, np.log(side.speed[0]), EXPONENT[0], 0.0])
    high = np.array([top, 5.0 * top, np.log(side.speed[-1]), EXPONENT[1], 2.0 * top / side.speed[-1]])
    least = float(side.friction.min())
    found = [
        least_squares(
            lambda x: (friction(x, side.speed) - side.friction) * weight,
            np.clip([0.8 * least, 0.4 * least, np.log(speed), 1.5, 0.2 * top / side.speed[-1]], low, high),
            bounds=(low, high),
            x_scale=[top, top, 1.0, 1.0, top / side.speed[-1]],
        )
        for speed in np.exp(low[2] + STARTS * (high[2] - low[2]))
    ]
    best = min(found, key=lambda result: result.cost)
    gain = np.linalg.pinv(best.jac) * weight
    # The allowances count node by node: as one error that all nodes share, they would leave the fall's place and shape
    # too certain, which on joints of known friction then lay outside their intervals one time in three.
    unseen = np.diag((side.unseen / float(stats.norm.ppf(LEVEL))) ** 2)
    covariance = gain @ (side.covariance + unseen) @ gain.T
    return _named(
        best.x, covariance, bound_notes(best.x.tolist(), low.tolist(), high.tolist()), len(side.speed) - len(best.x)
    )


def _named(x: Array, covariance: Array, notes: Sequence[str], freedom: int) -> CurveFit:
    """Estimates by name; those that stand at the end of their range say so."""
    deviation = np.sqrt(np.diag(covariance))
    fall = f"static friction over Coulomb friction {notes[1]}" if notes[1] else ""
    sum_deviation = float(np.sqrt(covariance[0, 0] + covariance[1, 1] + 2.0 * covariance[0, 1]))
    speed = float(np.exp(x[2]))
    return CurveFit(
        estimate(float(x[0]), float(deviation[0]), freedom, "N*m", note=notes[0]),
        estimate(float(x[0] + x[1]), sum_deviation, freedom, "N*m", share=SLOWEST_ALLOWANCE, note=fall),
        estimate(speed, speed * float(deviation[2]), freedom, "rad/s", note=notes[2]),
        estimate(float(x[3]), float(deviation[3]), freedom, "1", note=notes[3]),
        estimate(float(x[4]), float(deviation[4]), freedom, "N*m*s/rad", note=notes[4]),
    )
