"""The observers of the laws: the bristle that the friction laws follow, and the torque that no model knows.

Stands under `pd_dob`, `pd_lugre` and `local`. Plain floats, compiled by numba as they are. The friction state must not
wind up where the limits cut the torque; the disturbance observer cannot, for it works with the torque that acted.
"""

from __future__ import annotations

import math

from servod.kernels.laws.state import LawState

# --- Friction state -----------------------------------------------------------------------------------------------
# Its step is exact: explicit Euler gets it wrong at 1 ms, where the decay reaches 10 000 1/s.


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


#: Less difference than this between asked and applied torque is rounding.
LIMITED_NM = 1e-9


def winding_up(s: LawState, push: float, u_applied: float) -> bool:
    """Whether the limits cut the last torque (asked against applied) and `push` would ask for still more of it."""
    cut = s.asked - u_applied
    return (cut > LIMITED_NM and push > 0.0) or (cut < -LIMITED_NM and push < 0.0)


# --- Disturbance observer -----------------------------------------------------------------------------------------


def limited(value: float, bound: float) -> float:
    """`value` within +-`bound`; NaN stays NaN, so that the limits see it."""
    if value > bound:
        return bound
    if value < -bound:
        return -bound
    return value


def observe(
    s: LawState,
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
    `s.acted`. At the first step there is no last sample, and the estimate stays.
    """
    if s.started > 0.0 and dt > 0.0:
        residual = s.acted - s.modelled - inertia * (v - s.last_velocity) / dt
        estimate = s.d_hat - (residual - s.d_hat) * math.expm1(-bandwidth_rad_s * dt)
        s.d_hat = limited(estimate, limit_nm)
    return s.d_hat


def remember(s: LawState, v: float, modelled_nm: float, u_applied: float) -> None:
    """Keep what the next step's `observe` compares with; to be called once in every step, also in those that hold."""
    s.acted = u_applied
    s.last_velocity = v
    s.modelled = modelled_nm
    s.started = 1.0
