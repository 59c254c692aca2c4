"""The full sampled closed loop around one velocity: joint with bristle, delay, velocity filter and the law itself.

Stands on `sampled` and on `law_slopes`, the control law's own step function linearised numerically as it is: friction
state, disturbance observer, schedules and l_i are in it because they are in the law. States: [x, v, z, v_f, u_(k-1),
..., law state]. A joint is judged where it slides steadily (the bristle follows g(v)), where the bristle still sticks
(b = 1) and where it is being turned over after a reversal (b = 2).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

import numpy as np

from servod.formats.gains.design import SHARES, Uncertainty
from servod.kernels.laws.state import N_STATES
from servod.lab.verify.law_slopes import LawSlopes
from servod.lab.verify.sampled import Array, SampledTiming, with_delay_and_filter, with_lag
from servod.lab.verify.steady_friction import SteadyFriction

STUCK_DECAY_PER_S = 1000.0  # of the bristle state where the stiffness acts on the position and the state does nothing


class LinearBristle(Enum):
    """What the bristle does in a linearisation: value is z over its steady value, which gives dz'/dv = 1 - value."""

    SLIDES = 1.0
    STICKS = 0.0
    TURNS = -1.0


@dataclass(frozen=True, slots=True)
class Behind:
    """What the motor drives through a spring: m_L v_L' = k*(x - x_L) + c*(v - v_L) - viscous*v_L, per unit of gain."""

    inertia: float
    stiffness: float
    damping: float
    viscous: float

    def attached(self, a: Array, b: Array, e: Array, motor_inertia: float) -> tuple[Array, Array, Array]:
        """A motor's (A, B, E) in x, v, z with the load as two more states, x_L and v_L."""
        k, c, m = self.stiffness, self.damping, self.inertia
        full = np.zeros((5, 5))
        full[:3, :3] = a
        pull = np.array([k, c, 0.0, -k, -c])
        full[1] -= pull / motor_inertia
        full[3, 4] = 1.0
        full[4] = (pull - np.array([0.0, 0.0, 0.0, 0.0, self.viscous])) / m
        return full, np.pad(b, (0, 2)), np.pad(e, (0, 2))


@dataclass(frozen=True, slots=True)
class JointPoint:
    """The joint linearised: z' = -a z + b v, m v' = gain*u - sigma0 z - sigma1 z' - viscous v - slope x + w.

    With something `behind` a spring, `inertia` is the motor's alone, which has friction and encoder.
    """

    velocity: float
    bristle: LinearBristle
    inertia: float
    gain: float
    decay: float
    build_up: float
    stiffness: float
    damping: float
    viscous: float
    position_slope: float = 0.0
    behind: Behind | None = None

    def matrices(self) -> tuple[Array, Array, Array]:
        """(A, B, E) in states x, v, z, and those of what is behind a spring."""
        rigid = self._rigid()
        return self.behind.attached(*rigid, self.inertia) if self.behind else rigid

    def _rigid(self) -> tuple[Array, Array, Array]:
        """(A, B, E) in states x, v, z.

        At rest z - x is constant and cannot be controlled, so the stiffness acts on the position itself.
        """
        m, s1 = self.inertia, self.damping
        b, e = np.array([0.0, self.gain / m, 0.0]), np.array([0.0, 1.0 / m, 0.0])
        if self.decay == 0.0:
            stuck = [-(self.stiffness + self.position_slope) / m, -(self.viscous + s1) / m, 0.0]
            return np.array([[0.0, 1.0, 0.0], stuck, [0.0, 0.0, -STUCK_DECAY_PER_S]]), b, e
        row = [
            -self.position_slope / m,
            -(self.viscous + s1 * self.build_up) / m,
            -(self.stiffness - s1 * self.decay) / m,
        ]
        a = np.array([[0.0, 1.0, 0.0], row, [0.0, self.build_up, -self.decay]])
        return a, b, e


@dataclass(frozen=True, slots=True)
class LoopDeviation:
    """Factors on the model's values: one corner, or an inner point, of the intervals.

    `dry` scales g(v) with its slope; `slope` makes the slope steeper than that. No factors are `position_slope`, what
    cogging, gravity and springs add as stiffness [N*m/rad], and `more_viscous`, what is added to viscous friction
    [N*m*s/rad]; `delay_s` is added to the delay. Of the inertia `behind` has its part, where the joint has a spring.
    """

    inertia: float = 1.0
    torque_gain: float = 1.0
    stiffness: float = 1.0
    damping: float = 1.0
    dry: float = 1.0
    slope: float = 1.0
    viscous: float = 1.0
    position_slope: float = 0.0
    more_viscous: float = 0.0
    delay_s: float = 0.0
    behind: Behind | None = None


@dataclass(frozen=True, slots=True)
class Reach:
    """Ends of the factors that effects of the model itself put on its values, over its travel and its temperatures."""

    inertia: tuple[float, float] = (1.0, 1.0)
    torque_gain: tuple[float, float] = (1.0, 1.0)
    dry: tuple[float, float] = (1.0, 1.0)
    viscous: tuple[float, float] = (1.0, 1.0)

    def end(self, name: str, sign: float) -> float:
        """The lower (`sign` below zero) or upper end of one value; 1.0 for a value that no effect reaches."""
        low, high = getattr(self, name, (1.0, 1.0))
        return float(low if sign < 0.0 else high)


NO_REACH = Reach()

#: Parts of the delay's interval at which inner points lie: joints of one delay are judged together.
DELAY_STEPS = (-1.0, -0.5, 0.0, 0.5, 1.0)


def corners(u: Uncertainty, reach: Reach = NO_REACH) -> list[LoopDeviation]:
    """Every corner of the intervals that matter to small deviations; the level of dry friction moves with its slope.

    `reach` widens them by what the model's own effects make of a value.
    """
    names = ("inertia", "stiffness", "damping", "slope", "viscous")
    found = []
    for signs in itertools.product((-1.0, 1.0), repeat=len(names)):
        factors: dict[str, Any] = {
            n: (1.0 + s * getattr(u, n)) * reach.end(n, s) for n, s in zip(names, signs, strict=True)
        }
        gain = (1.0 - signs[0] * u.torque_gain) * reach.end("torque_gain", -signs[0])
        corner = LoopDeviation(**factors, torque_gain=gain, dry=(1.0 + signs[3] * u.dry) * reach.end("dry", signs[3]))
        found += [replace(corner, delay_s=delay) for delay in sorted({-u.delay_s, u.delay_s})]
    return found


def late_corners(u: Uncertainty) -> list[LoopDeviation]:
    """The corners with the longest delay: where a design is looked for, before all are judged."""
    return [corner for corner in corners(u) if corner.delay_s == u.delay_s]


def inner_points(u: Uncertainty, count: int, seed: int) -> list[LoopDeviation]:
    """`count` points of the intervals, uniformly at random."""
    random = np.random.default_rng(seed)
    draws = random.uniform(-1.0, 1.0, (count, len(SHARES)))
    delays = random.choice(DELAY_STEPS, count) * u.delay_s
    factors: list[dict[str, Any]] = [
        {n: float(1.0 + d * getattr(u, n)) for n, d in zip(SHARES, row, strict=True)} for row in draws
    ]
    return [LoopDeviation(**own, delay_s=float(delay)) for own, delay in zip(factors, delays, strict=True)]


def joint_points(
    friction: SteadyFriction, velocity: float, bristle: LinearBristle, cases: Sequence[LoopDeviation]
) -> list[JointPoint]:
    """The joint at `velocity` [rad/s] in each case, with the true Stribeck slope in how the bristle builds up."""
    speed, dry, damping = abs(velocity), friction.dry(velocity), friction.damping(velocity)
    slope, viscous = friction.dry_slope(velocity) if speed else 0.0, friction.viscous(velocity)
    points = []
    for d in cases:
        stiffness, level = friction.stiffness * d.stiffness, dry * d.dry
        build_up = speed * slope * d.slope / dry
        points.append(
            JointPoint(
                velocity,
                bristle,
                friction.inertia * d.inertia - (d.behind.inertia if d.behind else 0.0),
                d.torque_gain,
                stiffness * speed / level,
                1.0 - bristle.value + bristle.value * build_up if speed else 1.0,
                stiffness,
                damping * d.damping,
                viscous * d.viscous + d.more_viscous,
                d.position_slope,
                d.behind,
            )
        )
    return points


def joint_point(friction: SteadyFriction, velocity: float, bristle: LinearBristle, d: LoopDeviation) -> JointPoint:
    """The joint at `velocity` [rad/s] in one case."""
    return joint_points(friction, velocity, bristle, (d,))[0]


def sampled_points(points: Sequence[JointPoint], timing: SampledTiming) -> tuple[Array, Array, int]:
    """(A, B) of each joint, sampled with delay and velocity filter, and which state is the filtered velocity.

    It is what every law closes its loop around.
    """
    parts = [point.matrices() for point in points]
    a, b, e = (np.array(part) for part in zip(*parts, strict=True))
    a, b, e = with_lag(a, b, e, timing.lag_s)
    plant_a, plant_b, _ = with_delay_and_filter(a, b, e, timing)
    return plant_a, plant_b, a.shape[-1]


def loops(points: Sequence[JointPoint], law: LawSlopes, timing: SampledTiming) -> tuple[Array, Array, Array]:
    """(closed loops, torque input column, row that gives the law's torque) for joints under one linearised law."""
    return loops_around(*sampled_points(points, timing), law)


def loops_around(plant_a: Array, plant_b: Array, filtered: int, law: LawSlopes) -> tuple[Array, Array, Array]:
    """The same for joints that are sampled already.

    States that the law keeps constant (a held disturbance estimate, the flag of the first step) are left out.
    """
    n = plant_a.shape[-1]
    keep = [i for i in range(N_STATES) if i not in law.frozen]
    seen = [0, 1, *(2 + i for i in keep)]
    row = np.zeros(n + len(keep))
    row[[0, filtered, *range(n, n + len(keep))]] = law.matrix[0, seen]
    closed = np.zeros((len(plant_a), len(row), len(row)))
    closed[:, :n, :n] = plant_a
    column = np.concatenate([plant_b, np.zeros((len(plant_a), len(keep)))], axis=1)
    closed += column[:, :, None] * row
    for j, i in enumerate(keep):
        closed[:, n + j, [0, filtered, *range(n, n + len(keep))]] = law.matrix[1 + i, seen]
    return closed, column, row


def spectral_radius(closed: Array) -> Array:
    """Largest pole magnitude of each loop."""
    radius: Array = np.abs(np.linalg.eigvals(closed)).max(axis=-1)
    return radius
