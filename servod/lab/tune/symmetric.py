"""One friction curve for both directions, fitted to the axis model's map: what the LuGre observer (18) can hold.

Stands on the steady friction. The paper's observer has one set of parameters; that a real joint's directions differ is
its handicap by nature and not by tuning.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from servod.lab.verify.steady_friction import SteadyFriction

Array = NDArray[np.float64]

SPEEDS = 60
SLOWEST_SHARE = 1e-3  # of the largest speed; slower, friction is presliding


@dataclass(frozen=True, slots=True)
class SymmetricFriction:
    """F_C, F_S [N*m], v_s [rad/s] and F_v [N*m*s/rad] of (18)."""

    coulomb: float
    static: float
    stribeck_velocity: float
    viscous: float

    def torque(self, speed: Array) -> Array:
        """Steady friction at `speed` > 0."""
        fall = np.exp(-((speed / self.stribeck_velocity) ** 2))
        steady: Array = self.coulomb + (self.static - self.coulomb) * fall + self.viscous * speed
        return steady


def symmetric(friction: SteadyFriction, speed_max: float) -> SymmetricFriction:
    """Least squares over the mean of both directions, up to `speed_max` [rad/s].

    For each v_s the other three are linear and at least zero; v_s is searched on a grid. F_S is at least F_C.
    """
    speed: Array = np.geomspace(SLOWEST_SHARE * speed_max, speed_max, SPEEDS)
    mean = np.array([0.5 * (friction.torque(v) - friction.torque(-v)) for v in speed.tolist()])
    fits = [_fit(speed, mean, v_s) for v_s in np.geomspace(0.01 * speed_max, speed_max, 80).tolist()]
    return min(fits, key=lambda fit: fit[0])[1]


def _fit(speed: Array, torque: Array, v_s: float) -> tuple[float, SymmetricFriction]:
    """(relative residual, curve) with the given v_s; a map without a dry part counts a thousandth as dry."""
    from scipy.optimize import nnls

    parts = np.stack([np.ones_like(speed), np.exp(-((speed / v_s) ** 2)), speed], axis=1)
    (coulomb, fall, viscous), residual = nnls(parts / torque[:, None], np.ones_like(speed))
    dry = max(float(coulomb), 1e-3 * float(torque.max()))
    return float(residual), SymmetricFriction(dry, dry + float(fall), v_s, float(viscous))
