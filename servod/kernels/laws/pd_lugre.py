"""PD with the LuGre observer (18): one friction law for both directions, as the paper compares with.

    z_hat' = v - (c0*|v|/g(v))*z_hat + l_f*u*,      u* = u_feedback/K
    F_hat  = c0*z_hat + sigma1*z_hat' + F_v*v,      g(v) = F_C + (F_S - F_C)*exp(-(v/v_s)^2)
    u      = K_P*(x_ref - x) + K_D*(v_ref - v) + m_ff*a_ref + F_hat

c0 is sigma0 of Table I; the exponent is negative (printed positive, g would grow without bound); l_f has the sign
that makes z_hat push the way the feedback pushes. z_hat is stepped exactly and bounded (F_max/c0, below (8)).
"""

from __future__ import annotations

import math
from typing import NamedTuple

from servod.kernels.laws.observers import decayed, limited, winding_up
from servod.kernels.laws.state import LawState


class PdLugreGains(NamedTuple):
    """Numbers of the law, in the order in which a gain set packs them."""

    k_p: float  # position gain [N*m/rad]
    k_d: float  # velocity gain [N*m*s/rad]
    feedforward_inertia: float  # m_ff [kg*m^2]
    stiffness: float  # c0 = sigma0 [N*m/rad]
    damping: float  # sigma1 [N*m*s/rad]
    viscous: float  # F_v [N*m*s/rad]
    coulomb: float  # F_C [N*m]
    static: float  # F_S [N*m]
    stribeck_velocity: float  # v_s [rad/s]
    observer_gain: float  # l_f [rad/s per unit of u*]
    input_scale: float  # K [N*m per unit of u*]
    hold_within: float  # below this error, with the reference at rest, l_f does not act [rad]
    state_limit: float  # bound of |z_hat| [rad]


def step(
    p: PdLugreGains,
    s: LawState,
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
    feedback = p.k_p * error + p.k_d * (v_ref - v)
    level = p.coulomb + (p.static - p.coulomb) * math.exp(-((v / p.stribeck_velocity) ** 2))
    drive = v
    at_rest = v_ref == 0.0 and a_ref == 0.0 and abs(error) <= p.hold_within
    if not (at_rest or winding_up(s, feedback, u_applied)):
        drive += p.observer_gain * feedback / p.input_scale
    before = s.z_hat
    z = limited(decayed(before, p.stiffness * abs(v) / level, drive, dt), p.state_limit)
    s.z_hat = z
    rate = (z - before) / dt if dt > 0.0 else 0.0
    friction = p.stiffness * z + p.damping * rate + p.viscous * v
    other = p.feedforward_inertia * a_ref
    torque = feedback + friction + other
    s.asked = torque
    return torque, feedback, friction, other
