"""PD law: the paper's simplest controller (Fig. 10, 15), and the feedback of `pd_dob` and `pd_lugre`.

u = K_P*(x_ref - x) + K_D*(v_ref - v) + m_ff*a_ref
"""

from __future__ import annotations

from typing import NamedTuple

from servod.kernels.laws.state import LawState


class PdGains(NamedTuple):
    """Numbers of the PD law, in the order in which a gain set packs them."""

    k_p: float  # position gain [N*m/rad]
    k_d: float  # velocity gain [N*m*s/rad]
    feedforward_inertia: float  # m_ff [kg*m^2], 0 switches the feed-forward off


def step(
    p: PdGains,
    s: LawState,
    x_ref: float,
    v_ref: float,
    a_ref: float,
    x: float,
    v: float,
    u_applied: float,
    dt: float,
) -> tuple[float, float, float, float]:
    """One cycle: (torque, of it feedback, friction compensation, other) in N*m. No state but the torque asked for."""
    feedback = p.k_p * (x_ref - x) + p.k_d * (v_ref - v)
    other = p.feedforward_inertia * a_ref
    torque = feedback + other
    s.asked = torque
    return torque, feedback, 0.0, other
