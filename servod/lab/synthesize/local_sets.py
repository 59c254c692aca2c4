"""Local sets from the friction-velocity map: where the v_i stand, and the a_i that give their friction, by (7).

Stands on the steady friction; its result is the `friction` block of a gain set. Every direction has its own nodes. The
force between nodes is what the law's own interpolation gives, so the tolerance holds for the law that runs.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from servod.common.errors import BadInput
from servod.formats.gains.parameters import LocalFrictionSets, LocalSet, PositionFeedforward, PositionWave
from servod.formats.model.axis_model import AxisModel, wave_number
from servod.formats.model.effects import Spring
from servod.kernels.laws import MAX_SETS
from servod.kernels.laws.position import MAX_WAVES
from servod.lab.verify.steady_friction import SteadyFriction

#: v_i of Table I.
PAPER_NODES = (-0.5, -0.2, -0.01, -0.001, 0.0, 0.001, 0.05, 0.12, 0.5)
#: c0_hat as a share of the lowest c0 in its interval: stable with one to three cycles of delay; 1.0 is marginal.
STIFFNESS_SHARE = 0.8
#: Bound of the compensated force, as a share of the largest friction.
LIMIT_SHARE = 1.5
#: Tolerance of the force between local sets, as a share of it.
ACCURACY = 0.02
#: t_f of (8): what a set has to reach its force.
FINITE_TIME_S = 0.1
GRID = 400  # speeds per direction at which the tolerance is checked


@dataclass(frozen=True, slots=True)
class Compensator:
    """c0_hat [N*m/rad] and d0_hat [N*m*s/rad], common to all sets."""

    stiffness: float
    viscous: float

    def decay(self, friction: SteadyFriction, velocity: float) -> float:
        """a_i of (7) at steady state, c0*|v|/(F - d0*|v|), signed per direction by the map itself; 0 at rest by (6)."""
        speed = abs(velocity)
        if speed == 0.0:
            return 0.0
        rest = abs(friction.torque(velocity)) - self.viscous * speed
        return self.stiffness * speed / rest

    def torque(self, decay: float, speed: float) -> float:
        """Steady torque of a set with `decay` [1/s] at `speed` [rad/s]: (7) read the other way."""
        return self.stiffness * speed / decay + self.viscous * speed


def input_scale(friction: SteadyFriction, speed: float) -> float:
    """K: the power of ten next to the largest friction up to `speed`, 0.1 N*m for the paper's joint."""
    return float(10.0 ** round(math.log10(friction.largest(speed))))


def compensator(friction: SteadyFriction, speed_max: float, stiffness_share: float) -> Compensator:
    """The common parts: c0_hat below the stability bound; d0_hat so that no dry friction is left below zero."""
    sides = [side * speed_max for side in (1.0, -1.0)]
    return Compensator(stiffness_share * friction.stiffness, min(friction.viscous(v) for v in sides))


def _worst(friction: SteadyFriction, c: Compensator, side: float, low: float, high: float, grid: list[float]) -> float:
    """Largest relative force error between two neighbouring nodes with linear weights."""
    a_low, a_high = c.decay(friction, side * low), c.decay(friction, side * high)
    worst = 0.0
    for speed in grid:
        decay = a_low + (a_high - a_low) * (speed - low) / (high - low)
        truth = abs(friction.torque(side * speed))
        worst = max(worst, abs(c.torque(decay, speed) - truth) / truth)
    return worst


def node_speeds(
    friction: SteadyFriction, c: Compensator, side: float, slowest: float, speed: float, share: float
) -> list[float]:
    """Speeds of the nodes of one direction, each as far from the last as the tolerance `share` of the force allows.

    Greedy along the speed, so nodes are dense where friction bends. `slowest` is the first node: below it the force is
    that of the first node.
    """
    grid = [float(v) for v in np.geomspace(slowest, speed, GRID)]
    nodes, start = [grid[0]], 0
    while start < GRID - 1:
        near, far = start + 1, GRID - 1
        while near < far:
            middle = (near + far + 1) // 2
            fits = _worst(friction, c, side, grid[start], grid[middle], grid[start + 1 : middle]) <= share
            near, far = (middle, far) if fits else (near, middle - 1)
        start = near
        nodes.append(grid[start])
    return nodes


def local_sets(
    friction: SteadyFriction, c: Compensator, speed_max: float, accuracy: float, gain: float
) -> list[LocalSet]:
    """The local sets with forces within `accuracy` (a share) between nodes, up to `speed_max`, all with l_i = `gain`.

    Raises BadInput when more sets would be needed than the law holds.
    """
    slowest = 1e-3 * speed_max
    nodes = {0.0}
    for side in (1.0, -1.0):
        nodes |= {side * v for v in node_speeds(friction, c, side, slowest, speed_max, accuracy)}
    if len(nodes) > MAX_SETS:
        raise BadInput("--accuracy", f"{accuracy:g}, which needs {len(nodes)} local sets", f"at most {MAX_SETS} sets")
    return sets_at(friction, c, tuple(sorted(nodes)), gain)


def sets_at(friction: SteadyFriction, c: Compensator, nodes: tuple[float, ...], gain: float) -> list[LocalSet]:
    """Sets at given velocities, as the paper's nine: a_i by (7)."""
    return [LocalSet(velocity_rad_s=v, decay_per_s=c.decay(friction, v), gain=gain) for v in nodes]


def force_after(c: Compensator, decay: float, velocity: float, time_s: float) -> float:
    """Torque of one set `time_s` after it took over with z = 0: one side of (8)."""
    settled = -math.expm1(-decay * time_s) / decay if decay > 0.0 else time_s
    return (c.stiffness * settled + c.viscous) * velocity


def adjacent_mismatch(c: Compensator, sets: list[LocalSet], time_s: float) -> list[float]:
    """Right minus left side of (8) for each pair of neighbours, after t_f = `time_s` [N*m].

    A check, not a rule: taken literally (8) asks for equal forces in all sets. It vanishes where the map is flat, and
    shows where neighbouring sets differ in force or are too slow to reach it.
    """
    forces = [force_after(c, s.decay_per_s, s.velocity_rad_s, time_s) for s in sets]
    return [upper - lower for lower, upper in itertools.pairwise(forces)]


class Mismatch(NamedTuple):
    """Two neighbouring sets of one direction, and by how much their forces differ in (8)."""

    from_rad_s: float
    to_rad_s: float
    difference_nm: float
    share: float


def largest_mismatch(law: LocalFrictionSets, time_s: float = FINITE_TIME_S) -> Mismatch | None:
    """The neighbours of one direction that (8) finds furthest apart, as a share of the larger force; or None."""
    c, sets = Compensator(law.stiffness_nm_per_rad, law.viscous_nms_per_rad), law.sets
    pairs = zip(itertools.pairwise(sets), adjacent_mismatch(c, sets, time_s), strict=True)
    found = []
    for (lower, upper), difference in pairs:
        if lower.velocity_rad_s * upper.velocity_rad_s > 0.0:
            forces = [abs(force_after(c, s.decay_per_s, s.velocity_rad_s, time_s)) for s in (lower, upper)]
            share = abs(difference) / max(forces)
            found.append(Mismatch(lower.velocity_rad_s, upper.velocity_rad_s, difference, share))
    return max(found, key=lambda pair: pair.share, default=None)


# --- Feed-forward over position --------------------------------------------------------------------------------------
# The law's feed-forward of what the axis model knows over position: gravity, cogging, spring, constant torque. Its
# result is the `position_feedforward` block of a gain set. Torques are divided by the model's torque gain, as the
# steady friction is: what the law must ask for, not what the joint feels.


def position_feedforward(model: AxisModel, gain: float, period_s: float) -> PositionFeedforward | None:
    """What holds against the position-dependent torques of `model` with torque gain `gain`; None where it has none.

    Of more waves than the law holds, the largest are taken. The reference is led by the delay, the actuator's lag and
    half a period, the middle of the time for which a command acts.
    """
    waves = sorted(_waves(model, gain), key=lambda w: -abs(w.amplitude_nm))[:MAX_WAVES]
    if not waves and model.spring is None and model.torque_offset == 0.0:
        return None
    spring = model.spring or Spring()
    return PositionFeedforward(
        lead_s=model.acts_after_s + 0.5 * period_s,
        offset_nm=-model.torque_offset / gain,
        spring_nm_per_rad=spring.stiffness / gain,
        spring_rest_rad=spring.rest,
        spring_cubic_nm_per_rad3=spring.cubic / gain,
        waves=waves,
    )


def _waves(model: AxisModel, gain: float) -> list[PositionWave]:
    """Gravity as one wave a turn, then the harmonics of cogging."""
    gravity = model.gravity
    first = [(gravity.amplitude, 1.0, gravity.phase)] if gravity else []
    harmonics = model.cogging.harmonics if model.cogging else ()
    rows = [*first, *((h.amplitude, wave_number(h), h.phase) for h in harmonics)]
    return [PositionWave(amplitude_nm=a / gain, waves_per_turn=n, phase_rad=phase) for a, n, phase in rows if a != 0.0]
