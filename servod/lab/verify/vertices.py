"""Vertices of a region: the ends of the identified intervals as linear joints, ready for the LMIs of the deployed mode.

Stands on the steady friction; synthesis solves over these vertices, verification makes them again from the model and
compares. A frozen a_i would imply the damping g/v; what acts on a small deviation is the true slope g'(v), below zero
where the Stribeck curve falls, and sigma1 makes it act at once. Near rest the bristle sticks (stiffness c0,
damping sigma1) or has broken away and slides: both are vertices of Omega_L.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from servod.formats.gains.design import Uncertainty
from servod.formats.model.axis_model import AxisModel
from servod.formats.model.identified import Identified, IdentifiedValue
from servod.kernels.laws.local import COMMANDS
from servod.lab.verify.closed_loop import LinearBristle, LoopDeviation, joint_point
from servod.lab.verify.sampled import Array, SampledTiming, with_delay_and_filter
from servod.lab.verify.steady_friction import SteadyFriction

GRID = 40  # speeds that are compared, in each direction
LEAST_SPEED = 0.1  # share of the upper speed of Omega_L from which on it counts: below it the bristle only creeps


@dataclass(frozen=True, slots=True)
class VertexJoint:
    """One vertex: dx/dt = A x + B u + E w with states position, velocity, bristle.

    `mode` is the polytope that it is a corner of: the bristle slides or sticks. `performs` says whether the H2
    norm counts here: not where the Stribeck curve falls.
    """

    name: str
    mode: str
    performs: bool
    a: Array
    b: Array
    e: Array


@dataclass(frozen=True, slots=True)
class Span:
    """The speeds of one region; Omega_L holds rest, where the bristle may stick."""

    name: str
    from_rad_s: float
    to_rad_s: float

    @property
    def holds_rest(self) -> bool:
        """Whether zero velocity lies in the region."""
        return self.from_rad_s == 0.0


def ends(share: float) -> tuple[float, float]:
    """Both ends of the interval of half width `share`, as factors."""
    return 1.0 - share, 1.0 + share


def extremes(friction: SteadyFriction, span: Span, u: Uncertainty) -> tuple[float, float]:
    """Velocities of the region at which the joint is least and most stable by itself, over both directions [rad/s].

    Least stable is not where friction falls most: the slower the joint, the longer its bristle takes to follow.
    """
    lowest = LEAST_SPEED * span.to_rad_s if span.holds_rest else span.from_rad_s
    velocities = [side * float(v) for side in (1.0, -1.0) for v in np.geomspace(lowest, span.to_rad_s, GRID)]
    worse = LoopDeviation(dry=1.0 + u.dry, slope=1.0 + u.slope, viscous=1.0 - u.viscous)
    joints = np.array([joint_point(friction, v, LinearBristle.SLIDES, worse).matrices()[0] for v in velocities])
    growth = np.linalg.eigvals(joints[:, 1:, 1:]).real.max(axis=1)
    slopes = [friction.dry_slope(v) + friction.viscous(v) for v in velocities]
    return velocities[int(np.argmax(growth))], velocities[int(np.argmax(slopes))]


def sliding(friction: SteadyFriction, span: Span, u: Uncertainty) -> list[VertexJoint]:
    """The joint where friction falls most (every end of what makes that worse) and where it rises most."""
    falls, rises = extremes(friction, span, u)
    slope = friction.dry_slope(falls) * (1.0 + u.slope) * (1.0 + u.dry) + friction.viscous(falls) * (1.0 - u.viscous)
    found = []
    for mass, damping in itertools.product(ends(u.inertia), ends(u.damping)):
        gain = 1.0 + u.torque_gain if mass < 1.0 else 1.0 - u.torque_gain
        shared: dict[str, Any] = {"inertia": mass, "torque_gain": gain, "damping": damping}
        size = f"{'light' if mass < 1.0 else 'heavy'} {'ringing' if damping < 1.0 else 'damped'}"
        worse = LoopDeviation(**shared, dry=1.0 + u.dry, slope=1.0 + u.slope, viscous=1.0 - u.viscous)
        better = LoopDeviation(**shared, dry=1.0 - u.dry, viscous=1.0 + u.viscous)
        for name, velocity, deviation, performs in (
            ("falling", falls, worse, slope >= 0.0),
            ("rising", rises, better, True),
        ):
            matrices = joint_point(friction, velocity, LinearBristle.SLIDES, deviation).matrices()
            found.append(VertexJoint(f"sliding {name} {size}", "sliding", performs, *matrices))
    return found


def sticking(friction: SteadyFriction, u: Uncertainty) -> list[VertexJoint]:
    """The joint on its bristle: every end of stiffness, damping and inertia."""
    found = []
    for stiff, damped, mass in itertools.product(ends(u.stiffness), ends(u.damping), ends(u.inertia)):
        gain = 1.0 + u.torque_gain if mass < 1.0 else 1.0 - u.torque_gain
        corner = LoopDeviation(mass, gain, stiff, damped, viscous=1.0 - u.viscous)
        name = f"sticking {'soft' if stiff < 1.0 else 'stiff'} {'ringing' if damped < 1.0 else 'damped'}"
        matrices = joint_point(friction, 0.0, LinearBristle.STICKS, corner).matrices()
        found.append(VertexJoint(f"{name} {'light' if mass < 1.0 else 'heavy'}", "sticking", True, *matrices))
    return found


def joints(friction: SteadyFriction, span: Span, uncertainty: Uncertainty) -> list[VertexJoint]:
    """All vertices of the region: sliding, and sticking where it holds rest."""
    stuck = sticking(friction, uncertainty) if span.holds_rest else []
    return sliding(friction, span, uncertainty) + stuck


def fed_commands(timing: SampledTiming) -> int:
    """Number of past commands that are fed back: those that still act or wait, and one that the velocity lags."""
    return min(max(timing.kept_commands, round(timing.delay_s / timing.period_s) + 1), COMMANDS)


def known_commands(timing: SampledTiming) -> int:
    """Number of past commands among the states: those that are fed back, and those of a longer delay that still act."""
    return max(fed_commands(timing), timing.kept_commands)


def sampled_vertices(found: list[VertexJoint], timing: SampledTiming) -> tuple[Array, Array, Array]:
    """(A, B, E) of all vertices, states [x, v_f, u_(k-1), ..., v - v_f, z]: what the law feeds back comes first."""
    a, b, e = (np.array([getattr(joint, name) for joint in found]) for name in ("a", "b", "e"))
    full_a, full_b, full_e = _with_memory(*with_delay_and_filter(a, b, e, timing), timing)
    change = _to_feedback_first(full_a.shape[-1])
    back = np.linalg.inv(change)
    return change @ full_a @ back, full_b @ change.T, full_e @ change.T


def _with_memory(a: Array, b: Array, e: Array, timing: SampledTiming) -> tuple[Array, Array, Array]:
    """The same systems with the commands that are only remembered as further states at the end."""
    size, more = a.shape[-1], known_commands(timing) - timing.kept_commands
    full_a = np.pad(a, ((0, 0), (0, more), (0, more)))
    full_b, full_e = np.pad(b, ((0, 0), (0, more))), np.pad(e, ((0, 0), (0, more)))
    for i in range(size, size + more):
        if i > size or timing.kept_commands:
            full_a[:, i, i - 1] = 1.0
        else:
            full_b[:, i] = 1.0
    return full_a, full_b, full_e


def _to_feedback_first(size: int) -> Array:
    """From [x, v, z, v_f, u_(k-1), ...] to [x, v_f, u_(k-1), ..., v - v_f, z]."""
    change = np.zeros((size, size))
    change[0, 0] = 1.0
    for row in range(1, size - 2):
        change[row, row + 2] = 1.0
    change[size - 2, 1], change[size - 2, 3] = 1.0, -1.0
    change[size - 1, 2] = 1.0
    return change


# --- Half widths -----------------------------------------------------------------------------------------------------
# Half widths of what an identification measured, as shares of the values: what a design's intervals must hold.
# Synthesis widens them to its floors, verification compares them with the design. An interval need not be even: the
# wider side counts, as wide as it was measured.


#: Names of identified values, by the key of Uncertainty that they bound; of several the widest counts.
MEASURED = {
    "inertia": ("inertia",),
    "stiffness": ("sigma0",),
    "damping": ("sigma1",),
    "viscous": ("viscous_positive", "viscous_negative"),
}
#: Bristle damping that could not be measured is assumed at half of the critical one. Bearings and gears are found
#: between a quarter and three quarters of it; below, the bristle would ring for long enough to be measured after all.
ASSUMED_DAMPING = 0.5
#: Least half widths: what a day's warming may change, and what a fit of four digits would be too proud of; the delay's
#: is what a cycle jitters [s].
FLOORS = {
    "inertia": 0.02,
    "stiffness": 0.05,
    "damping": 0.25,
    "viscous": 0.1,
    "dry": 0.03,
    "slope": 0.1,
    "delay_s": 20e-6,
}
FALL_ENDS = 2.0  # Stribeck velocities: beyond, the map is wider in N*m and says nothing about the fall


def measured_widths(model: AxisModel) -> dict[str, float]:
    """Half widths by key of Uncertainty, `delay_s` in s; empty for a model that was not identified."""
    known = model.identified
    if known is None:
        return {}
    shares = {key: _widest(known.values, names) for key, names in MEASURED.items()}
    found = {key: share for key, share in shares.items() if share is not None}
    if "sigma1" in known.not_identifiable:
        found["damping"] = ASSUMED_DAMPING
    if "delay_s" in known.values:
        delay, lag = known.values["delay_s"], known.values.get("lag_s")
        # where no lag was told, the delay reaches down by the longest that may be a part of it; and as a part of it, a
        # lag turns the phase no further than the delay that it is taken for
        hidden = lag.high if lag is not None and lag.value == 0.0 else 0.0
        early = delay.value - max(delay.low, 0.0) - hidden  # no torque comes before it is asked for
        late = delay.high - delay.value
        if lag is not None and lag.value > 0.0:  # one that was told may be longer: as delay it is the harder
            late += lag.high - lag.value
        found["delay_s"] = max(late, early)
    return found | _of_map(known)


def least_widths(model: AxisModel) -> dict[str, float]:
    """Half widths below which a design's intervals may not be: the floors, and a stated default where that is less."""
    measured, default = measured_widths(model), Uncertainty().model_dump()
    least = {key: floor if key in measured else min(floor, default[key]) for key, floor in FLOORS.items()}
    return least | {"delay_s": min(least["delay_s"], model.total_delay_s)}


def _widest(values: dict[str, IdentifiedValue], names: tuple[str, ...]) -> float | None:
    shares = [_half_width(values[n]) / values[n].value for n in names if n in values and values[n].value > 0.0]
    return max(shares, default=None)


def _half_width(value: IdentifiedValue) -> float:
    return max(value.high - value.value, value.value - value.low)


def _of_map(known: Identified) -> dict[str, float]:
    """Level: the widest node by its torque. Slope: two nodes that err apart, over the fall from F_S to F_C."""
    found = known.friction_map
    level = max(abs(half / torque) for half, torque in zip(found.half_widths, found.torques, strict=True))
    slopes = [_slope_share(known, side, sign) for side, sign in (("positive", 1.0), ("negative", -1.0))]
    known_slopes = [slope for slope in slopes if slope is not None]
    return {"dry": level} | ({"slope": max(known_slopes)} if known_slopes else {})


def _slope_share(known: Identified, side: str, sign: float) -> float | None:
    """Half width of the fall in one direction; None where no fall was found."""
    names = [f"{name}_{side}" for name in ("static", "coulomb", "stribeck_velocity")]
    if not all(name in known.values for name in names):
        return None
    static, coulomb, speed = (known.values[name].value for name in names)
    nodes = zip(known.friction_map.velocities, known.friction_map.half_widths, strict=True)
    widths = [half for v, half in nodes if 0.0 < sign * v <= FALL_ENDS * speed]
    return math.sqrt(2.0) * max(widths) / (static - coulomb) if widths and static > coulomb else None
