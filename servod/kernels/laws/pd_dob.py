"""PD with a disturbance observer: friction is whatever the nominal inertia and viscous friction do not explain.

    u = K_P*(x_ref - x) + K_D*(v_ref - v) + m_ff*a_ref + d_hat
    d_hat' = g*(u_applied - b*v - m*v' - d_hat)                      ([22] in the paper; Fig. 18, left)

A reference at rest and an error within the hold width freeze d_hat: an integrator and stiction would hunt for ever.
"""

from __future__ import annotations

from collections.abc import MutableSequence, Sequence

from servod.kernels.laws.observer import observe, remember
from servod.kernels.laws.state import ASKED, DISTURBANCE

K_P = 0  # position gain [N*m/rad]
K_D = 1  # velocity gain [N*m*s/rad]
FEEDFORWARD_INERTIA = 2  # m_ff [kg*m^2]
BANDWIDTH = 3  # g [rad/s]
INERTIA = 4  # nominal m [kg*m^2]
VISCOUS = 5  # nominal b [N*m*s/rad]
LIMIT = 6  # bound of |d_hat| [N*m]
HOLD_WITHIN = 7  # hold width [rad]
N_PARAMETERS = 8


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
    """One cycle: (torque, of it feedback, friction compensation, other) in N*m; d_hat counts as other."""
    error = x_ref - x
    feedback = p[K_P] * error + p[K_D] * (v_ref - v)
    at_rest = v_ref == 0.0 and a_ref == 0.0 and abs(error) <= p[HOLD_WITHIN]
    if not at_rest:
        observe(s, p[BANDWIDTH], p[INERTIA], p[LIMIT], v, u_applied, dt)
    remember(s, v, p[VISCOUS] * v, u_applied)
    other = p[FEEDFORWARD_INERTIA] * a_ref + s[DISTURBANCE]
    torque = feedback + other
    s[ASKED] = torque
    return torque, feedback, 0.0, other
