"""PD with a disturbance observer: friction is whatever the nominal inertia and viscous friction do not explain.

    u = K_P*(x_ref - x) + K_D*(v_ref - v) + m_ff*a_ref + d_hat
    d_hat' = g*(u_applied - b*v - m*v' - d_hat)                      ([22] in the paper; Fig. 18, left)

A reference at rest and an error within the hold width freeze d_hat: an integrator and stiction would hunt for ever.
"""

from __future__ import annotations

from typing import NamedTuple

from servod.kernels.laws.observers import observe, remember
from servod.kernels.laws.state import LawState


class PdDobGains(NamedTuple):
    """Numbers of the law, in the order in which a gain set packs them."""

    k_p: float  # position gain [N*m/rad]
    k_d: float  # velocity gain [N*m*s/rad]
    feedforward_inertia: float  # m_ff [kg*m^2]
    bandwidth: float  # g [rad/s]
    inertia: float  # nominal m [kg*m^2]
    viscous: float  # nominal b [N*m*s/rad]
    limit: float  # bound of |d_hat| [N*m]
    hold_within: float  # hold width [rad]


def step(
    p: PdDobGains,
    s: LawState,
    x_ref: float,
    v_ref: float,
    a_ref: float,
    x: float,
    v: float,
    u_applied: float,
    dt: float,
) -> tuple[float, float, float, float]:
    """One cycle: (torque, of it feedback, friction compensation, other) in N*m; d_hat counts as other."""
    error = x_ref - x
    feedback = p.k_p * error + p.k_d * (v_ref - v)
    at_rest = v_ref == 0.0 and a_ref == 0.0 and abs(error) <= p.hold_within
    if not at_rest:
        observe(s, p.bandwidth, p.inertia, p.limit, v, u_applied, dt)
    remember(s, v, p.viscous * v, u_applied)
    other = p.feedforward_inertia * a_ref + s.d_hat
    torque = feedback + other
    s.asked = torque
    return torque, feedback, 0.0, other
