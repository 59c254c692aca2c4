"""Disturbance observer: the torque that the model does not know, from the torque that really acted.

Stands under `pd_dob` and `local`. Because it works with the torque after limits it cannot wind up.
"""

from __future__ import annotations

import math
from collections.abc import MutableSequence

from servod.kernels.laws.exact import limited
from servod.kernels.laws.state import ACTED, DISTURBANCE, LAST_VELOCITY, MODELLED, STARTED


def observe(
    s: MutableSequence[float],
    bandwidth_rad_s: float,
    inertia: float,
    limit_nm: float,
    v: float,
    u_applied: float,
    dt: float,
) -> float:
    """New estimate d_hat [N*m] of d in m*v' = u - F_hat - d, first order with `bandwidth_rad_s`, exact over `dt`.

    d_hat' = g*(u - F_hat - m*v' - d_hat), the observer of [22] in the paper. A torque of cycle k acts from sample k+1
    on, so the torque behind the step from the last sample to this one is the one that was given two calls ago:
    `s[ACTED]`. At the first step there is no last sample, and the estimate stays.
    """
    if s[STARTED] > 0.0 and dt > 0.0:
        residual = s[ACTED] - s[MODELLED] - inertia * (v - s[LAST_VELOCITY]) / dt
        estimate = s[DISTURBANCE] - (residual - s[DISTURBANCE]) * math.expm1(-bandwidth_rad_s * dt)
        s[DISTURBANCE] = limited(estimate, limit_nm)
    return s[DISTURBANCE]


def remember(s: MutableSequence[float], v: float, modelled_nm: float, u_applied: float) -> None:
    """Keep what the next step's `observe` compares with; to be called once in every step, also in those that hold."""
    s[ACTED] = u_applied
    s[LAST_VELOCITY] = v
    s[MODELLED] = modelled_nm
    s[STARTED] = 1.0
