"""PD law: the paper's simplest controller (Fig. 10, 15), and the feedback of `pd_dob` and `pd_lugre`.

u = K_P*(x_ref - x) + K_D*(v_ref - v) + m_ff*a_ref
"""

from __future__ import annotations

from collections.abc import MutableSequence, Sequence

from servod.kernels.laws.state import ASKED

K_P = 0  # position gain [N*m/rad]
K_D = 1  # velocity gain [N*m*s/rad]
FEEDFORWARD_INERTIA = 2  # m_ff [kg*m^2], 0 switches the feed-forward off
N_PARAMETERS = 3


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
    """One cycle: (torque, of it feedback, friction compensation, other) in N*m. No state but the torque asked for."""
    feedback = p[K_P] * (x_ref - x) + p[K_D] * (v_ref - v)
    other = p[FEEDFORWARD_INERTIA] * a_ref
    torque = feedback + other
    s[ASKED] = torque
    return torque, feedback, 0.0, other
