"""Local-model law (9), (16): friction state with a decay per local set, and state feedback scheduled over two regions.

    z_hat' = -a(v)*z_hat + v + l(v)*u*,   a = sum mu_i*a_i,  l = sum mu_i*l_i                               (9)
    u*     = mu_L*(k_x e + k_v e' - k_z z_hat)|L + mu_H*(k_x e + k_v e' - k_z z_hat)|H,   e = x_ref - x     (13), (16)
    u      = K*u* + c0*z_hat + d0*v + m_ff*a_ref + T(x_ref) + d_hat                                         (16)

In sampled time the state that (13) feeds back has more in it than position and velocity: commands that were given and
do not show in the velocity yet. Each region may take -k_u(i)*u*(k-i) of the last commands, as the limits let them
through, which is the predictor that the delay asks for (0: none). T is what is known over position
(servod.kernels.laws.position). All three gains are negative feedback. l > 0 makes z_hat push the way the feedback
pushes (integral action through the friction state); the other sign is harmful. Every direction has its own nodes, so
asymmetry needs nothing special.
Options: the velocity of z_hat, of d0 and of the sets is the measured one or the reference's, led by a stated time;
an output disturbance observer around the whole (bandwidth 0: none). The regions go by the faster of both velocities:
a step has no reference velocity, yet the gains of Omega_L on a joint that turns fast make a limit cycle.
Far from its goal, as in a step, the joint is approached with a bounded speed: the feedback sees a limited error.
The observer has bandwidths of its own in Omega_L: one for coming to rest, under a reference that rests, and one under
a reference that moves. There a fast one may take friction that turns over for a disturbance, and throw the joint
forward by what it has gathered.
At rest: within the hold width neither l nor the observer acts, so nothing hunts. Driven by the measured velocity z_hat
creeps with its noise, and the leak floor lets it fade; driven by the reference it stays as it is, for letting it fade
would only move the joint, by F/(c0 + k_x).
Longer at rest the joint stands on its bristle, far stiffer than any feedback, and feedback and observer would only move
it with the encoder's noise: a stated share of them is left, which stops creep, and all of it is back within
milliseconds when the error grows beyond what the encoder may show of a joint that stands, or the reference moves.
"""

from __future__ import annotations

import math
from collections.abc import MutableSequence, Sequence

from servod.kernels.laws.observer import decayed, limited, observe, remember, winds_up
from servod.kernels.laws.position import position_torque
from servod.kernels.laws.state import ASKED, COMMAND_1, COMMAND_2, COMMAND_3, DISTURBANCE, FRICTION_STATE, REST
from servod.kernels.laws.weights import blended

INPUT_SCALE = 0  # K [N*m per unit of u*]
LOW_K_Z, LOW_K_X, LOW_K_V = 1, 2, 3  # gains of Omega_L [1/rad, 1/rad, s/rad]
HIGH_K_Z, HIGH_K_X, HIGH_K_V = 4, 5, 6  # gains of Omega_H
BLEND_FROM = 7  # speed up to which Omega_L holds alone [rad/s]
BLEND_TO = 8  # speed from which Omega_H holds alone [rad/s]
STIFFNESS = 9  # c0_hat [N*m/rad]
VISCOUS = 10  # d0_hat [N*m*s/rad]
LEAK = 11  # least decay of z_hat [1/s]
STATE_LIMIT = 12  # bound of |z_hat| [rad], F_max/c0 as below (8)
SOURCE = 13  # VelocitySource
LEAD = 14  # time by which the reference velocity is led [s]
SHAPE = 15  # servod.kernels.laws.weights.Shape
HOLD_WITHIN = 16  # hold width [rad]
FEEDFORWARD_INERTIA = 17  # m_ff [kg*m^2]
OBSERVER_BANDWIDTH = 18  # g of the output disturbance observer in Omega_H [rad/s], 0: none
OBSERVER_INERTIA = 19  # nominal m of the observer [kg*m^2]
OBSERVER_LIMIT = 20  # bound of |d_hat| [N*m]
LOW_K_U, HIGH_K_U = 21, 24  # gains of the last three commands u* in Omega_L and Omega_H
OBSERVER_LOW = 27  # g in Omega_L under a resting reference [rad/s]: on its bristle the estimate would take seconds
ERROR_LIMIT = 28  # the feedback sees no more error than this, which bounds the speed of a step [rad], 0: none
REST_WITHIN = 29  # error within which a joint under a resting reference counts as at rest [rad], 0: never
REST_SHARE = 30  # of feedback and observer that is left at rest
OBSERVER_MOVING = 31  # g in Omega_L under a moving reference [rad/s]
N_SETS = 32  # number n of local sets
FIRST_NODE = 33  # then n nodes v_i [rad/s], n decays a_i [1/s], n gains l_i; then `position`, or nothing

MEASURED = 0.0
REFERENCE = 1.0
REST_TO_S, REST_FROM_S = 0.02, 0.004  # time constants with which a joint comes to count as at rest, and ceases to
COMMANDS = 3  # past commands that may be fed back: those of two cycles of delay, and one that the velocity lags behind


def remembered(p: Sequence[float], s: Sequence[float], first: int) -> float:
    """Sum of k_u(i)*u*(k-i) with the gains from p[first] on."""
    return p[first] * s[COMMAND_1] + p[first + 1] * s[COMMAND_2] + p[first + 2] * s[COMMAND_3]


def awake(p: Sequence[float], s: MutableSequence[float], stands: bool, error: float, dt: float) -> float:
    """Share of feedback and observer that acts: 1, and going towards REST_SHARE while the joint is at rest."""
    if p[REST_WITHIN] == 0.0:
        s[REST] = 0.0
    elif stands and abs(error) <= p[REST_WITHIN]:
        s[REST] = 1.0 + (s[REST] - 1.0) * math.exp(-dt / REST_TO_S)
    else:
        s[REST] *= math.exp(-dt / REST_FROM_S)
    return 1.0 - s[REST] * (1.0 - p[REST_SHARE])


def high_share(p: Sequence[float], speed: float) -> float:
    """Share of Omega_H at `speed` [rad/s]: 0 in Omega_L, 1 in Omega_H, linear over the overlap."""
    if speed <= p[BLEND_FROM]:
        return 0.0
    if speed >= p[BLEND_TO]:
        return 1.0
    return (speed - p[BLEND_FROM]) / (p[BLEND_TO] - p[BLEND_FROM])


def scheduled(p: Sequence[float], s: Sequence[float], share: float, error: float, error_rate: float) -> float:
    """u* of (13), blended with `share` of Omega_H."""
    z, star = s[FRICTION_STATE], 0.0
    if share < 1.0:
        low = p[LOW_K_X] * error + p[LOW_K_V] * error_rate - p[LOW_K_Z] * z - remembered(p, s, LOW_K_U)
        star += (1.0 - share) * low
    if share > 0.0:
        high = p[HIGH_K_X] * error + p[HIGH_K_V] * error_rate - p[HIGH_K_Z] * z - remembered(p, s, HIGH_K_U)
        star += share * high
    return star


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
    """One cycle: (torque, of it feedback K*u*, friction compensation, other) in N*m."""
    w = v_ref + p[LEAD] * a_ref if p[SOURCE] == REFERENCE else v
    error = x_ref - x
    s[COMMAND_1] -= (s[ASKED] - u_applied) / p[INPUT_SCALE]  # what the limits cut never acts
    share = high_share(p, max(abs(w), abs(v)))
    seen = limited(error, p[ERROR_LIMIT]) if p[ERROR_LIMIT] > 0.0 else error
    stands = v_ref == 0.0 and a_ref == 0.0
    acts = awake(p, s, stands, error, dt)
    u_star = acts * scheduled(p, s, share, seen, v_ref - v)
    s[COMMAND_3], s[COMMAND_2], s[COMMAND_1] = s[COMMAND_2], s[COMMAND_1], u_star
    moves = not (stands and abs(error) <= p[HOLD_WITHIN])
    n = int(p[N_SETS])
    decay, gain = blended(p, FIRST_NODE, n, p[SHAPE], w)
    drive = w
    if moves and gain != 0.0 and not winds_up(s, u_star, u_applied):
        drive += gain * u_star
    if moves or p[SOURCE] != REFERENCE:
        s[FRICTION_STATE] = limited(decayed(s[FRICTION_STATE], max(decay, p[LEAK]), drive, dt), p[STATE_LIMIT])
    friction = p[STIFFNESS] * s[FRICTION_STATE] + p[VISCOUS] * w
    beyond = FIRST_NODE + 3 * n
    known = position_torque(p, beyond, x_ref, v_ref) if len(p) > beyond else 0.0
    other = p[FEEDFORWARD_INERTIA] * a_ref + known
    if p[OBSERVER_BANDWIDTH] > 0.0:
        if moves:
            low = p[OBSERVER_LOW] if stands else p[OBSERVER_MOVING]
            bandwidth = low + share * (p[OBSERVER_BANDWIDTH] - low)
            observe(s, acts * bandwidth, p[OBSERVER_INERTIA], p[OBSERVER_LIMIT], v, u_applied, dt)
        remember(s, v, friction + known, u_applied)
        other += s[DISTURBANCE]
    feedback = p[INPUT_SCALE] * u_star
    torque = feedback + friction + other
    s[ASKED] = torque
    return torque, feedback, friction, other
