"""PD with the LuGre observer (18): one friction law for both directions, as the paper compares with.

    z_hat' = v - (c0*|v|/g(v))*z_hat + l_f*u*,      u* = u_feedback/K
    F_hat  = c0*z_hat + sigma1*z_hat' + F_v*v,      g(v) = F_C + (F_S - F_C)*exp(-(v/v_s)^2)
    u      = K_P*(x_ref - x) + K_D*(v_ref - v) + m_ff*a_ref + F_hat

c0 is sigma0 of Table I; the exponent is negative (printed positive, g would grow without bound); l_f has the sign
that makes z_hat push the way the feedback pushes. z_hat is stepped exactly and bounded (F_max/c0, below (8)).
"""

from __future__ import annotations

import math
from collections.abc import MutableSequence, Sequence

from servod.kernels.laws.observer import decayed, limited, winds_up
from servod.kernels.laws.state import ASKED, FRICTION_STATE

K_P = 0  # position gain [N*m/rad]
K_D = 1  # velocity gain [N*m*s/rad]
FEEDFORWARD_INERTIA = 2  # m_ff [kg*m^2]
STIFFNESS = 3  # c0 = sigma0 [N*m/rad]
DAMPING = 4  # sigma1 [N*m*s/rad]
VISCOUS = 5  # F_v [N*m*s/rad]
COULOMB = 6  # F_C [N*m]
STATIC = 7  # F_S [N*m]
STRIBECK_VELOCITY = 8  # v_s [rad/s]
OBSERVER_GAIN = 9  # l_f [rad/s per unit of u*]
INPUT_SCALE = 10  # K [N*m per unit of u*]
HOLD_WITHIN = 11  # below this error, with the reference at rest, l_f does not act [rad]
STATE_LIMIT = 12  # bound of |z_hat| [rad]
N_PARAMETERS = 13


def step(
    p: Sequence[float],
    s: MutableSequence[float],
    x_ref: float,
    v_ref: float,
    a_ref: float,
    x: float,
    v: float,
    u_applied: float,
    dt: float,
) -> tuple[float, float, float, float]:
    """One cycle: (torque, of it feedback, friction compensation, other) in N*m."""
    error = x_ref - x
    feedback = p[K_P] * error + p[K_D] * (v_ref - v)
    level = p[COULOMB] + (p[STATIC] - p[COULOMB]) * math.exp(-((v / p[STRIBECK_VELOCITY]) ** 2))
    drive = v
    at_rest = v_ref == 0.0 and a_ref == 0.0 and abs(error) <= p[HOLD_WITHIN]
    if not (at_rest or winds_up(s, feedback, u_applied)):
        drive += p[OBSERVER_GAIN] * feedback / p[INPUT_SCALE]
    before = s[FRICTION_STATE]
    z = limited(decayed(before, p[STIFFNESS] * abs(v) / level, drive, dt), p[STATE_LIMIT])
    s[FRICTION_STATE] = z
    rate = (z - before) / dt if dt > 0.0 else 0.0
    friction = p[STIFFNESS] * z + p[DAMPING] * rate + p[VISCOUS] * v
    other = p[FEEDFORWARD_INERTIA] * a_ref
    torque = feedback + friction + other
    s[ASKED] = torque
    return torque, feedback, friction, other
