"""Checks of effects that a diagnosis adds to a model: the sampled loop at the ends of what they do to the joint.

Stands on the loop, beside `checks`. Drawn plants are simulated with every effect as it is; here the
linearised loop gets its extremes, and each check states the range that was covered. A joint's spring is in it as a
resonance, a gap as a spring of any stiffness up to its own: what a dead zone is to a swing that passes it (its
describing function lies between nothing and the spring).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import reduce
from itertools import pairwise

from servod.formats.gains.design import Design
from servod.formats.gains.gain_set import CertificateCheck
from servod.formats.model import effects as fx
from servod.formats.model import friction as fr
from servod.formats.model.axis_model import AxisModel, wave_number
from servod.formats.model.keys import Group, Harmonic
from servod.kernels.physics.effects import SMALLEST_FACTOR, static_stretch
from servod.lab.verify.checks import CORNER_DISK, MOST_NAME, POLE_LIMIT, Subject, at_least, at_most
from servod.lab.verify.closed_loop import Behind, LoopDeviation, Reach, corners
from servod.lab.verify.steady_friction import SPRING_STRETCH_RAD, SteadyFriction, position_slopes, steady_friction

# --- Effects on the values of the joint ------------------------------------------------------------------------------
# What effects of the axis model do to the values of the joint: how far each value goes over travel and temperature. The
# loop check linearises a plain joint; an effect that scales a value, or adds a slope, is in it as the ends of an
# interval. One function for each group, in the table at the end; each gives bounds: amplitudes are summed as if they
# met in one place.


Ends = tuple[float, float]
ONE: Ends = (1.0, 1.0)
NONE: Ends = (0.0, 0.0)
#: A joint is as much warmer and colder than the model's reference at least, day by day.
DAY_C = 10.0
#: Factors up to which a drift without an end is followed; a straight line through a recording is no law for ever.
DRIFT: Ends = (0.5, 1.5)
STEEPEST_OF_BELL = math.exp(-0.5)  # slope of a Gaussian bump at one standard deviation, times its width


@dataclass(frozen=True, slots=True)
class ReachLevel:
    """Where an effect is judged: friction, top speed, and the largest torques of the motor and of the load [N*m].

    Torques of the joint, not of the command. The motor's is what holds the load and slides at top speed.
    """

    friction: SteadyFriction
    top_rad_s: float
    load_nm: float

    @property
    def torque_nm(self) -> float:
        """The motor's largest steady torque."""
        return self.friction.gain * self.friction.largest(self.top_rad_s) + self.load_nm

    @property
    def least_dry_nm(self) -> float:
        """The least dry friction of both directions at any speed."""
        speeds = [side * share * self.top_rad_s for side in (1.0, -1.0) for share in (0.001, 0.01, 0.1, 0.3, 1.0)]
        return self.friction.gain * min(self.friction.dry(v) for v in speeds)


@dataclass(frozen=True, slots=True)
class EffectReach:
    """One effect on the joint: ends of factors, ends of added stiffness [N*m/rad] and viscous friction [N*m*s/rad].

    `told` says over what, where that is no plain sum of amplitudes.
    """

    inertia: Ends = ONE
    torque_gain: Ends = ONE
    dry: Ends = ONE
    viscous: Ends = ONE
    position_slope: Ends = NONE
    more_viscous: Ends = NONE
    told: str = ""

    @property
    def reach(self) -> Reach:
        """The factors alone."""
        return Reach(self.inertia, self.torque_gain, self.dry, self.viscous)

    def and_also(self, other: EffectReach) -> EffectReach:
        """Both effects at once: factors multiply, what is added adds up."""

        def both(name: str) -> Ends:
            a, b = getattr(self, name), getattr(other, name)
            if name in ("position_slope", "more_viscous"):
                return a[0] + b[0], a[1] + b[1]
            return a[0] * b[0], a[1] * b[1]

        ends = {f.name: both(f.name) for f in fields(EffectReach) if f.name != "told"}
        return EffectReach(**ends, told=", ".join(part for part in (self.told, other.told) if part))


def level_of(model: AxisModel, friction: SteadyFriction, top_rad_s: float) -> ReachLevel:
    """The level of a model; a spring is judged where the position slopes judge it."""
    spring, load = model.spring, abs(model.gravity.amplitude) if model.gravity else 0.0
    if spring is not None:
        load += (spring.stiffness + spring.cubic * SPRING_STRETCH_RAD**2) * SPRING_STRETCH_RAD
    offset = drifted_offset(model, ReachLevel(friction, top_rad_s, load))
    return ReachLevel(friction, top_rad_s, load + abs(offset))


def drifted_offset(model: AxisModel, level: ReachLevel) -> float:
    """What the drift of the offset adds to the load at its end, N*m; one without an end is followed as a factor is."""
    drift = model.offset_drift
    if drift is None or drift.per_s == 0.0:
        return 0.0
    if drift.time_s is not None:
        return drift.per_s * drift.time_s
    return math.copysign((DRIFT[1] - 1.0) * level.least_dry_nm, drift.per_s)


def factor_range(share: float) -> Ends:
    """Factors of so much to both sides, above what a factor never falls below."""
    return max(1.0 - share, SMALLEST_FACTOR), 1.0 + share


def sums(harmonics: Sequence[Harmonic], power: int) -> float:
    """Sum of amplitude times wave number to `power`: bounds of the sum of waves and of its derivatives."""
    return sum(abs(h.amplitude) * wave_number(h) ** power for h in harmonics)


def _thermal(model: AxisModel, level: ReachLevel) -> EffectReach:
    """From the coldest to the warmest that the model knows, DAY_C around its reference at least."""
    t = model.thermal
    assert t is not None
    loss_w = level.torque_nm * level.top_rad_s
    known = (model.start_temperature_c, t.ambient_c, t.ambient_c + t.heating_c_per_j * loss_w * t.cooling_s)
    cold, warm = min(*known, t.reference_c - DAY_C), max(*known, t.reference_c + DAY_C)

    def ends(per_c: float, per_s: float) -> Ends:
        by_warmth = [per_c * (at - t.reference_c) for at in (cold, warm)]
        if t.shape is fr.ThermalShape.EXPONENTIAL:
            by_warmth = [math.exp(share) - 1.0 for share in by_warmth]
        drift = _drift(per_s, t.drift_time_s)
        found = [1.0 + share + more for share in by_warmth for more in (0.0, drift)]
        return max(min(found), SMALLEST_FACTOR), max(found)

    lasts = _lasts(max(abs(t.dry_per_s), abs(t.viscous_per_s))) if t.drift_time_s is None else ""
    told = f"{cold:.3g} to {warm:.3g} degC{lasts}"
    return EffectReach(dry=ends(t.dry_per_c, t.dry_per_s), viscous=ends(t.viscous_per_c, t.viscous_per_s), told=told)


def _drift(per_s: float, ends_after_s: float | None) -> float:
    """What a drift adds to a factor at its end; one without an end is followed as far as DRIFT."""
    if ends_after_s is not None:
        return per_s * ends_after_s
    return 0.0 if per_s == 0.0 else (DRIFT[0] if per_s < 0.0 else DRIFT[1]) - 1.0


def _lasts(per_s: float) -> str:
    return f", drift for {(DRIFT[1] - 1.0) / per_s:.3g} s" if per_s else ""


def _load_dependent(model: AxisModel, level: ReachLevel) -> EffectReach:
    """More dry friction by what is carried; and a part of each change of the command goes into friction at once."""
    f = model.load_dependent_friction
    assert f is not None
    share = min(f.per_command, 0.9)
    more = (share * level.torque_nm + f.per_load * level.load_nm) / (1.0 - share)
    return EffectReach(dry=(1.0, 1.0 + more / level.least_dry_nm), torque_gain=factor_range(share))


def _position_dependent(model: AxisModel, level: ReachLevel) -> EffectReach:
    """Friction over position; its slope is a stiffness, of either sign by the direction of motion."""
    f = model.position_dependent_friction
    assert f is not None
    waves, lows = sums(f.harmonics, 0), sum(min(b.factor, 0.0) for b in f.bumps)
    highs = sum(max(b.factor, 0.0) for b in f.bumps)
    steep = sums(f.harmonics, 1) + sum(abs(b.factor) * STEEPEST_OF_BELL / b.width for b in f.bumps)
    slope = steep * level.friction.gain * level.friction.largest(level.top_rad_s)
    return EffectReach(
        dry=(max(1.0 - waves + lows, SMALLEST_FACTOR), 1.0 + waves + highs), position_slope=(-slope, slope)
    )


def _ripple(model: AxisModel, level: ReachLevel) -> EffectReach:
    """A gain over position; with the torque that is asked for it is a stiffness as well."""
    assert model.torque_ripple is not None
    waves = model.torque_ripple.harmonics
    slope = sums(waves, 1) * level.torque_nm
    return EffectReach(torque_gain=factor_range(sums(waves, 0)), position_slope=(-slope, slope))


def _inertia(model: AxisModel, level: ReachLevel) -> EffectReach:
    """M(x), and dM/dx*v^2/2 at top speed with its slopes over position and velocity."""
    assert model.position_dependent_inertia is not None
    waves, behind = model.position_dependent_inertia.harmonics, model.two_mass
    mass = behind.load_inertia if behind else model.inertia
    slope = 0.5 * mass * sums(waves, 2) * level.top_rad_s**2
    viscous = mass * sums(waves, 1) * level.top_rad_s
    share = sums(waves, 0) * mass / model.inertia
    return EffectReach(inertia=factor_range(share), position_slope=(-slope, slope), more_viscous=(-viscous, viscous))


def _eccentricity(model: AxisModel, _level: ReachLevel) -> EffectReach:
    """Position and velocity are read by the same factor, which the loop cannot tell from torque gain."""
    assert model.encoder_eccentricity is not None
    return EffectReach(torque_gain=factor_range(sums(model.encoder_eccentricity.harmonics, 1)))


def _saturation(model: AxisModel, level: ReachLevel) -> EffectReach:
    """A soft limit lowers the gain near it: of limit*tanh(u/limit) 1 - (torque/limit)^2 is left."""
    s = model.torque_saturation
    assert s is not None
    share = min(level.torque_nm / min(s.limit, s.negative_limit or s.limit), 1.0)
    return EffectReach(torque_gain=(max(1.0 - share**2, SMALLEST_FACTOR), 1.0)) if s.shape == "tanh" else EffectReach()


def _gain_by_sign(model: AxisModel, level: ReachLevel) -> EffectReach:
    """Commands of one sign do more than those of the other; the loop stands on the mean of both."""
    g = model.torque_gain
    assert g is not None
    ends = sorted((g.factor / level.friction.gain, (g.negative_factor or g.factor) / level.friction.gain))
    return EffectReach(torque_gain=(ends[0], ends[1]))


def _offset_drift(model: AxisModel, level: ReachLevel) -> EffectReach:
    """A constant torque closes no loop: it is load, and until when a drift without an end is followed is told."""
    drift = model.offset_drift
    assert drift is not None
    end_nm = drifted_offset(model, level)
    if end_nm == 0.0:
        return EffectReach()
    lasts = f" after {end_nm / drift.per_s:.3g} s" if drift.time_s is None else ""
    return EffectReach(told=f"offset drifts by {end_nm:.2g} N*m{lasts}")


def _residual(model: AxisModel, _level: ReachLevel) -> EffectReach:
    """Tables over position and velocity by their steepest pieces; one over time acts from outside."""
    r = model.residual
    assert r is not None
    return EffectReach(position_slope=_steepest(r.position), more_viscous=_steepest(r.velocity))


def _steepest(table: fx.TorqueMap | None) -> Ends:
    if table is None:
        return NONE
    rows = zip(pairwise(table.grid), pairwise(table.torque), strict=True)
    slopes = [(after - before) / (end - start) for (start, end), (before, after) in rows]
    return min(0.0, *slopes), max(0.0, *slopes)


#: Groups that scale or shift what the loop has in it.
EFFECTS: dict[type[Group], Callable[[AxisModel, ReachLevel], EffectReach]] = {
    fr.Thermal: _thermal,
    fr.LoadDependentFriction: _load_dependent,
    fr.PositionDependentFriction: _position_dependent,
    fx.TorqueRipple: _ripple,
    fx.PositionDependentInertia: _inertia,
    fx.EncoderEccentricity: _eccentricity,
    fx.TorqueSaturation: _saturation,
    fx.TorqueGain: _gain_by_sign,
    fx.OffsetDrift: _offset_drift,
    fx.Residual: _residual,
}


def effects_of(model: AxisModel, level: ReachLevel) -> dict[str, EffectReach]:
    """Every effect that `model` has and that changes something, by its key; torques per unit of torque gain."""
    gain, found = level.friction.gain, {}
    names = {type(group): name for name, group in model.groups()}
    for group, effect in EFFECTS.items():
        if group not in names:
            continue
        e = effect(model, level)
        slope, viscous = ((low / gain, high / gain) for low, high in (e.position_slope, e.more_viscous))
        e = EffectReach(e.inertia, e.torque_gain, e.dry, e.viscous, slope, viscous, e.told)
        if e != EffectReach():
            found[names[group]] = e
    return found


# --- What no check carries -------------------------------------------------------------------------------------------
# What of an axis model no check of the sampled loop can carry. Drawn plants are simulated with every effect, but poles
# and margins are of a joint that is linearised: a certificate must not pass over the rest in silence.


#: Periods in which the torque must get from one end to the other: slower, its rate limit is a lag that grows.
SLEW_PERIODS = 5.0


def unknown_physics(model: AxisModel, period_s: float, level: ReachLevel) -> Iterator[str]:
    """Keys of the model that stay out of the loop, and why; what acts from outside closes no loop and is none."""
    lag, limit, load = model.actuator_lag, model.torque_saturation, model.load_dependent_friction
    slew = lag.slew_per_s if lag is not None else None
    if slew is not None and slew * SLEW_PERIODS * period_s < 2.0 * level.torque_nm:
        yield f"actuator_lag.slew_per_s turns the torque around in more than {SLEW_PERIODS:g} cycles"
    if limit is not None and min(limit.limit, limit.negative_limit or limit.limit) < level.torque_nm:
        yield f"torque_saturation.limit is below the {level.torque_nm:.3g} N*m of friction and load"
    if load is not None and load.per_command >= 0.9:
        yield "load_dependent_friction.per_command lets friction take what is commanded"


#: Shares of the contact's stiffness that a gap is judged with; without any, the motor is alone.
GAP_SHARES = (0.03, 0.1, 0.3, 1.0)
#: The check that there is none; no gain mends it.
PHYSICS_CHECK = "physics that the loop check does not know"
_WORDS = {"inertia": "inertia", "torque_gain": "gain", "dry": "dry friction", "viscous": "viscous friction"}


def check_effects(s: Subject) -> Iterator[CertificateCheck]:
    """Nothing that the loop check cannot carry, and a stable loop at the ends of what it can."""
    model, friction = s.design.model, s.coarse.friction
    level = level_of(model, friction, s.design.speed_max_rad_s)
    problems = list(unknown_physics(model, s.design.period_s, level))
    name = f"{PHYSICS_CHECK}{': ' if problems else ''}{', '.join(problems)}"
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


def late_effects(design: Design) -> list[LoopDeviation]:
    """Joints with the longest delay of the intervals at the ends of the model's effects: for who looks for a design."""
    model, friction = design.model, steady_friction(design.model)
    level = level_of(model, friction, design.speed_max_rad_s)
    effects = effects_of(model, level)
    cases: list[LoopDeviation] = []
    if effects:
        cases += [*corners(design.uncertainty, together(effects).reach), *ends(model, friction, effects)]
    if model.two_mass is not None:
        cases += sprung(model, level, ends(model, friction, effects))
    late = design.uncertainty.delay_s
    return [replace(case, delay_s=late) for case in cases if case.delay_s >= 0.0]


def together(effects: dict[str, EffectReach]) -> EffectReach:
    """All effects at once."""
    return reduce(EffectReach.and_also, effects.values(), EffectReach())


def ends(model: AxisModel, friction: SteadyFriction, effects: dict[str, EffectReach]) -> list[LoopDeviation]:
    """The joint as modelled at every end of its effects, with the slopes over position and velocity."""
    own = together(effects)
    falls, rises = position_slopes(model, friction.gain)
    found = []
    for mass, dry, viscous, slope in itertools.product((0, 1), repeat=4):
        found.append(
            LoopDeviation(
                inertia=own.inertia[mass],
                torque_gain=own.torque_gain[1 - mass],
                dry=own.dry[dry],
                viscous=own.viscous[viscous],
                more_viscous=own.more_viscous[viscous],
                position_slope=own.position_slope[slope] + (falls, rises)[slope],
            )
        )
    return found


def sprung(model: AxisModel, level: ReachLevel, cases: list[LoopDeviation]) -> list[LoopDeviation]:
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


def _loads(model: AxisModel, level: ReachLevel) -> Iterator[Behind]:
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


def covered(effects: dict[str, EffectReach]) -> str:
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
