"""Checks of effects that a diagnosis adds to a model: the sampled loop at the ends of what they do to the joint.

Stands on `effect_reach` and the loop, beside `checks`. Drawn plants are simulated with every effect as it is; here the
linearised loop gets its extremes, and each check states the range that was covered. A joint's spring is in it as a
resonance, a gap as a spring of any stiffness up to its own: what a dead zone is to a swing that passes it (its
describing function lies between nothing and the spring).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import replace
from functools import reduce

from servod.formats.gains.design import Design
from servod.formats.gains.gain_set import CertificateCheck
from servod.formats.model.axis_model import AxisModel
from servod.kernels.physics.effects import static_stretch
from servod.lab.verify.checks import CORNER_DISK, MOST_NAME, POLE_LIMIT, Subject, at_least, at_most
from servod.lab.verify.closed_loop import Behind, Deviation, corners
from servod.lab.verify.effect_reach import Effect, Level, effects_of, level_of
from servod.lab.verify.sampled import LONGEST_LAG
from servod.lab.verify.steady_friction import SteadyFriction, position_slopes, steady_friction

# What of an axis model no check of the sampled loop can carry.
#
# Stands on the axis model, under the checks of effects. Drawn plants are simulated with every effect, but poles and
# margins are of a joint that is linearised: a certificate must not pass over the rest in silence.


#: Periods in which the torque must get from one end to the other: slower, its rate limit is a lag that grows.
SLEW_PERIODS = 5.0


def unknown_physics(model: AxisModel, period_s: float, level: Level) -> Iterator[str]:
    """Keys of the model that stay out of the loop, and why; what acts from outside closes no loop and is none."""
    lag, limit, load = model.actuator_lag, model.torque_saturation, model.load_dependent_friction
    if lag is not None and lag.time_constant_s > LONGEST_LAG * period_s:
        yield "actuator_lag.time_constant_s is longer than a cycle"
    slew = lag.slew_per_s if lag is not None else None
    if slew is not None and slew * SLEW_PERIODS * period_s < 2.0 * level.torque_nm:
        yield f"actuator_lag.slew_per_s turns the torque around in more than {SLEW_PERIODS:g} cycles"
    if limit is not None and min(limit.limit, limit.negative_limit or limit.limit) < level.torque_nm:
        yield f"torque_saturation.limit is below the {level.torque_nm:.3g} N*m of friction and load"
    if load is not None and load.per_command >= 0.9:
        yield "load_dependent_friction.per_command lets friction take what is commanded"


#: Shares of the contact's stiffness that a gap is judged with; without any, the motor is alone.
GAP_SHARES = (0.03, 0.1, 0.3, 1.0)
_WORDS = {"inertia": "inertia", "torque_gain": "gain", "dry": "dry friction", "viscous": "viscous friction"}


def check_effects(s: Subject) -> Iterator[CertificateCheck]:
    """Nothing that the loop check cannot carry, and a stable loop at the ends of what it can."""
    model, friction = s.design.model, s.coarse.friction
    level = level_of(model, friction, s.design.speed_max_rad_s)
    problems = list(unknown_physics(model, s.design.period_s, level))
    name = f"physics that the loop check does not know{': ' if problems else ''}{', '.join(problems)}"
    yield at_most(name[:MOST_NAME], float(len(problems)), 0.0)
    effects = effects_of(model, level)
    if effects:
        cases = [*corners(s.design.uncertainty, together(effects).reach), *ends(model, friction, effects)]
        yield at_most(f"largest pole, {covered(effects)}"[:MOST_NAME], s.coarse.worst(cases).radius, POLE_LIMIT)
        margin = s.coarse.disk_margin(ends(model, friction, effects))[0]
        yield at_least("symmetric disk margin, ends of the model's own effects", margin, CORNER_DISK)
    if model.two_mass is not None:
        cases = sprung(model, level, corners(s.design.uncertainty, together(effects).reach))
        yield at_most(f"largest pole, {resonance(model)}", s.coarse.worst(cases).radius, POLE_LIMIT)


def late_effects(design: Design) -> list[Deviation]:
    """Joints with the longest delay of the intervals at the ends of the model's effects: for who looks for a design."""
    model, friction = design.model, steady_friction(design.model)
    level = level_of(model, friction, design.speed_max_rad_s)
    effects = effects_of(model, level)
    cases: list[Deviation] = []
    if effects:
        cases += [*corners(design.uncertainty, together(effects).reach), *ends(model, friction, effects)]
    if model.two_mass is not None:
        cases += sprung(model, level, ends(model, friction, effects))
    late = design.uncertainty.delay_s
    return [replace(case, delay_s=late) for case in cases if case.delay_s >= 0.0]


def together(effects: dict[str, Effect]) -> Effect:
    """All effects at once."""
    return reduce(Effect.and_also, effects.values(), Effect())


def ends(model: AxisModel, friction: SteadyFriction, effects: dict[str, Effect]) -> list[Deviation]:
    """The joint as modelled at every end of its effects, with the slopes over position and velocity."""
    own = together(effects)
    falls, rises = position_slopes(model, friction.gain)
    found = []
    for mass, dry, viscous, slope in itertools.product((0, 1), repeat=4):
        found.append(
            Deviation(
                inertia=own.inertia[mass],
                torque_gain=own.torque_gain[1 - mass],
                dry=own.dry[dry],
                viscous=own.viscous[viscous],
                more_viscous=own.more_viscous[viscous],
                position_slope=own.position_slope[slope] + (falls, rises)[slope],
            )
        )
    return found


def sprung(model: AxisModel, level: Level, cases: list[Deviation]) -> list[Deviation]:
    """`cases` with the load behind its spring: soft, stiffened, and with a gap."""
    found = [
        replace(case, behind=replace(load, inertia=case.inertia * load.inertia))
        for load in _loads(model, level)
        for case in cases
    ]
    if model.backlash is not None and model.two_mass is not None:
        alone = 1.0 - model.two_mass.load_inertia / model.inertia
        found += [replace(case, inertia=alone * case.inertia) for case in cases]
    return found


def _loads(model: AxisModel, level: Level) -> Iterator[Behind]:
    """The load behind every stiffness that its spring can have."""
    spring, gap, elastic, gain = model.two_mass, model.backlash, model.joint_elasticity, level.friction.gain
    assert spring is not None
    stiffnesses = [share * spring.stiffness for share in (GAP_SHARES if gap else (1.0,))]
    if elastic is not None and elastic.cubic > 0.0:
        into = static_stretch(level.friction.packed.p, level.torque_nm) - (0.5 * gap.gap if gap else 0.0)
        stiffnesses.append(spring.stiffness + 3.0 * elastic.cubic * into**2)
    for stiffness in stiffnesses:
        damping = spring.damping * min(stiffness / spring.stiffness, 1.0)
        yield Behind(spring.load_inertia / gain, stiffness / gain, damping / gain, spring.load_viscous / gain)


def covered(effects: dict[str, Effect]) -> str:
    """The ranges in words: what each value is multiplied with, and which effects do it."""
    own = together(effects)
    factors = [f"{word} {_range(getattr(own, key))}" for key, word in _WORDS.items() if _range(getattr(own, key))]
    slope = max(-own.position_slope[0], own.position_slope[1])
    factors += [f"slope {slope:.2g} N*m/rad"] if slope else []
    told = f" ({own.told})" if own.told else ""
    return f"{', '.join(factors)}{told}: {', '.join(effects)}".lstrip()


def _range(ends_of: tuple[float, float]) -> str:
    low, high = ends_of
    return "" if low == high == 1.0 else f"x {low:.2f} to {high:.2f}"


def resonance(model: AxisModel) -> str:
    """What is behind the motor, in words."""
    spring = model.two_mass
    assert spring is not None
    motor = model.inertia - spring.load_inertia
    hertz = math.sqrt(spring.stiffness * (1.0 / motor + 1.0 / spring.load_inertia)) / (2.0 * math.pi)
    gap = " and a gap (any stiffness up to it, and none)" if model.backlash is not None else ""
    return f"the joint's spring with a resonance at {hertz:.3g} Hz{gap}"
