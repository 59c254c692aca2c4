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
Options: the velocity w of z_hat, of d0 and of the sets is the measured one or the reference's, led by a stated time,
as it is or corrected by the error; an output disturbance observer around the whole (bandwidth 0: none).
The regions go by the faster of both velocities: a step has no reference velocity, yet the gains of Omega_L on a joint
that turns fast make a limit cycle.
Driven by the reference alone, the friction that is compensated has the reference's phase whatever the joint does: once
pushed, a joint may swing against it for ever, on ten times its error. The corrected reference goes the way back as
soon as the error is more than a bristle stretches, when the joint cannot but slide otherwise than the reference:
w = v_ref + (k_x/k_v)|L * (e beyond F_max/c0 and the hold width), the reference velocity of Slotine and Li with a dead
zone. The regions, which go by the faster of w and v, follow: a joint that is far off is fed back as one that slides.
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
from collections.abc import Sequence
from typing import Any, NamedTuple

from servod.kernels.laws.observers import decayed, limited, observe, remember, winding_up
from servod.kernels.laws.position import PositionTorques, position_torque
from servod.kernels.laws.state import LawState
from servod.kernels.laws.weights import Sets, blended


class LocalGains(NamedTuple):
    """Numbers of the law, in the order in which a gain set packs them; the number of sets goes before the sets."""

    input_scale: float  # K [N*m per unit of u*]
    low_k_z: float  # gains of Omega_L [1/rad, 1/rad, s/rad]
    low_k_x: float
    low_k_v: float
    high_k_z: float  # gains of Omega_H
    high_k_x: float
    high_k_v: float
    blend_from: float  # speed up to which Omega_L holds alone [rad/s]
    blend_to: float  # speed from which Omega_H holds alone [rad/s]
    stiffness: float  # c0_hat [N*m/rad]
    viscous: float  # d0_hat [N*m*s/rad]
    leak: float  # least decay of z_hat [1/s]
    state_limit: float  # bound of |z_hat| [rad], F_max/c0 as below (8)
    source: float  # MEASURED, REFERENCE or CORRECTED: whose velocity drives z_hat, d0 and the sets
    lead: float  # time by which the reference velocity is led [s]
    shape: float  # servod.kernels.laws.weights.Shape
    hold_within: float  # hold width [rad]
    feedforward_inertia: float  # m_ff [kg*m^2]
    observer_bandwidth: float  # g of the output disturbance observer in Omega_H [rad/s], 0: none
    observer_inertia: float  # nominal m of the observer [kg*m^2]
    observer_limit: float  # bound of |d_hat| [N*m]
    low_k_u1: float  # gains of the last three commands u* in Omega_L and Omega_H
    low_k_u2: float
    low_k_u3: float
    high_k_u1: float
    high_k_u2: float
    high_k_u3: float
    observer_low: float  # g in Omega_L under a resting reference [rad/s]: on its bristle it would take seconds
    error_limit: float  # the feedback sees no more error than this, which bounds the speed of a step [rad], 0: none
    rest_within: float  # error within which a joint under a resting reference counts as at rest [rad], 0: never
    rest_share: float  # of feedback and observer that is left at rest
    observer_moving: float  # g in Omega_L under a moving reference [rad/s]
    sets: Sets
    knows_position: bool = False  # whether `position` says anything
    position: PositionTorques = PositionTorques()

    @classmethod
    def from_flat(cls, values: Sequence[float]) -> LocalGains:
        """Name the numbers that `flat` gives; `Law.accepts` says whether they are as many as it takes."""
        n = int(values[N_SETS])
        nodes, decays, gains = (tuple(values[FIRST_NODE + k * n : FIRST_NODE + (k + 1) * n]) for k in range(3))
        beyond = values[FIRST_NODE + 3 * n :]
        known = len(beyond) > 0, PositionTorques.from_flat(beyond)
        return cls._make((*values[:N_SETS], Sets(nodes, decays, gains), *known))

    def flat(self) -> tuple[float, ...]:
        """The numbers one behind the other: head, number of sets, all v_i, all a_i, all l_i, what is known of position.

        So a gain set is packed and sent to the loop.
        """
        head: tuple[Any, ...] = self[:N_SETS]
        sets = self.sets
        known = self.position.flat() if self.knows_position else ()
        return (*head, float(len(sets.nodes)), *sets.nodes, *sets.decays, *sets.gains, *known)


N_SETS = 32  # where `flat` has the number of sets ...
FIRST_NODE = 33  # ... and the first of them

MEASURED = 0.0
REFERENCE = 1.0
CORRECTED = 2.0
REST_TO_S, REST_FROM_S = 0.02, 0.004  # time constants with which a joint comes to count as at rest, and ceases to
COMMANDS = 3  # past commands that may be fed back: those of two cycles of delay, and one that the velocity lags behind


def awake(p: LocalGains, s: LawState, stands: bool, error: float, dt: float) -> float:
    """Share of feedback and observer that acts: 1, and going towards REST_SHARE while the joint is at rest."""
    if p.rest_within == 0.0:
        s.rest = 0.0
    elif stands and abs(error) <= p.rest_within:
        s.rest = 1.0 + (s.rest - 1.0) * math.exp(-dt / REST_TO_S)
    else:
        s.rest *= math.exp(-dt / REST_FROM_S)
    return 1.0 - s.rest * (1.0 - p.rest_share)


def way_back(p: LocalGains, error: float) -> float:
    """Velocity that corrects the reference's [rad/s]: 0 up to the stretch of a bristle, then towards the reference.

    As fast as the feedback of Omega_L would bring the joint back, and no faster than the outermost set of that side.
    The hold width comes on top: so much of an error the encoder's steps alone may show.
    """
    beyond = abs(error) - p.state_limit - p.hold_within
    if beyond <= 0.0 or p.low_k_v <= 0.0:
        return 0.0
    speed = p.low_k_x / p.low_k_v * beyond
    return min(speed, p.sets.nodes[-1]) if error > 0.0 else max(-speed, p.sets.nodes[0])


def high_share(p: LocalGains, speed: float) -> float:
    """Share of Omega_H at `speed` [rad/s]: 0 in Omega_L, 1 in Omega_H, linear over the overlap."""
    if speed <= p.blend_from:
        return 0.0
    if speed >= p.blend_to:
        return 1.0
    return (speed - p.blend_from) / (p.blend_to - p.blend_from)


def scheduled(p: LocalGains, s: LawState, share: float, error: float, error_rate: float) -> float:
    """u* of (13), blended with `share` of Omega_H, less what the last commands have still to show."""
    z, star = s.z_hat, 0.0
    if share < 1.0:
        memory = p.low_k_u1 * s.command_1 + p.low_k_u2 * s.command_2 + p.low_k_u3 * s.command_3
        star += (1.0 - share) * (p.low_k_x * error + p.low_k_v * error_rate - p.low_k_z * z - memory)
    if share > 0.0:
        memory = p.high_k_u1 * s.command_1 + p.high_k_u2 * s.command_2 + p.high_k_u3 * s.command_3
        star += share * (p.high_k_x * error + p.high_k_v * error_rate - p.high_k_z * z - memory)
    return star


def step(
    p: LocalGains,
    s: LawState,
    x_ref: float,
    v_ref: float,
    a_ref: float,
    x: float,
    v: float,
    u_applied: float,
    dt: float,
) -> tuple[float, float, float, float]:
    """One cycle: (torque, of it feedback K*u*, friction compensation, other) in N*m."""
    w = v if p.source == MEASURED else v_ref + p.lead * a_ref
    error = x_ref - x
    stands = v_ref == 0.0 and a_ref == 0.0
    if p.source == CORRECTED:  # under a reference that rests too: between two moves the joint has not changed
        w += way_back(p, error)
    s.command_1 -= (s.asked - u_applied) / p.input_scale  # what the limits cut never acts
    share = high_share(p, max(abs(w), abs(v)))
    seen = limited(error, p.error_limit) if p.error_limit > 0.0 else error
    acts = awake(p, s, stands, error, dt)
    u_star = acts * scheduled(p, s, share, seen, v_ref - v)
    s.command_3, s.command_2, s.command_1 = s.command_2, s.command_1, u_star
    moves = not (stands and abs(error) <= p.hold_within)
    decay, gain = blended(p.sets, p.shape, w)
    drive = w
    if moves and gain != 0.0 and not winding_up(s, u_star, u_applied):
        drive += gain * u_star
    if moves or p.source == MEASURED:
        s.z_hat = limited(decayed(s.z_hat, max(decay, p.leak), drive, dt), p.state_limit)
    friction = p.stiffness * s.z_hat + p.viscous * w
    known = position_torque(p.position, x_ref, v_ref) if p.knows_position else 0.0
    other = p.feedforward_inertia * a_ref + known
    if p.observer_bandwidth > 0.0:
        if moves:
            low = p.observer_low if stands else p.observer_moving
            bandwidth = low + share * (p.observer_bandwidth - low)
            observe(s, acts * bandwidth, p.observer_inertia, p.observer_limit, v, u_applied, dt)
        remember(s, v, friction + known, u_applied)
        other += s.d_hat
    feedback = p.input_scale * u_star
    torque = feedback + friction + other
    s.asked = torque
    return torque, feedback, friction, other
