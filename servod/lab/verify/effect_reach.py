"""What effects of the axis model do to the values of the joint: how far each value goes over travel and temperature.

Stands on axis model and steady friction, under the checks of effects. The loop check linearises a plain joint; an
effect that scales a value, or adds a slope, is in it as the ends of an interval. One function for each group, in the
table at the end; each gives bounds: amplitudes are summed as if they met in one place.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from itertools import pairwise

from servod.formats.model import effects as fx
from servod.formats.model import friction as fr
from servod.formats.model.axis_model import AxisModel, wave_number
from servod.formats.model.keys import Group, Harmonic
from servod.kernels.physics.effects import SMALLEST_FACTOR
from servod.lab.verify.closed_loop import Reach
from servod.lab.verify.steady_friction import SPRING_STRETCH_RAD, SteadyFriction

Ends = tuple[float, float]
ONE: Ends = (1.0, 1.0)
NONE: Ends = (0.0, 0.0)
#: A joint is as much warmer and colder than the model's reference at least, day by day.
DAY_C = 10.0
#: Factors up to which a drift without an end is followed; a straight line through a recording is no law for ever.
DRIFT: Ends = (0.5, 1.5)
STEEPEST_OF_BELL = math.exp(-0.5)  # slope of a Gaussian bump at one standard deviation, times its width


@dataclass(frozen=True, slots=True)
class Level:
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
class Effect:
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

    def and_also(self, other: Effect) -> Effect:
        """Both effects at once: factors multiply, what is added adds up."""

        def both(name: str) -> Ends:
            a, b = getattr(self, name), getattr(other, name)
            if name in ("position_slope", "more_viscous"):
                return a[0] + b[0], a[1] + b[1]
            return a[0] * b[0], a[1] * b[1]

        ends = {f.name: both(f.name) for f in fields(Effect) if f.name != "told"}
        return Effect(**ends, told=", ".join(part for part in (self.told, other.told) if part))


def level_of(model: AxisModel, friction: SteadyFriction, top_rad_s: float) -> Level:
    """The level of a model; a spring is judged where the position slopes judge it."""
    spring, load = model.spring, abs(model.gravity.amplitude) if model.gravity else 0.0
    if spring is not None:
        load += (spring.stiffness + spring.cubic * SPRING_STRETCH_RAD**2) * SPRING_STRETCH_RAD
    offset = drifted_offset(model, Level(friction, top_rad_s, load))
    return Level(friction, top_rad_s, load + abs(offset))


def drifted_offset(model: AxisModel, level: Level) -> float:
    """What the drift of the offset adds to the load at its end, N*m; one without an end is followed as a factor is."""
    drift = model.offset_drift
    if drift is None or drift.per_s == 0.0:
        return 0.0
    if drift.time_s is not None:
        return drift.per_s * drift.time_s
    return math.copysign((DRIFT[1] - 1.0) * level.least_dry_nm, drift.per_s)


def around(share: float) -> Ends:
    """Factors of so much to both sides, above what a factor never falls below."""
    return max(1.0 - share, SMALLEST_FACTOR), 1.0 + share


def sums(harmonics: Sequence[Harmonic], power: int) -> float:
    """Sum of amplitude times wave number to `power`: bounds of the sum of waves and of its derivatives."""
    return sum(abs(h.amplitude) * wave_number(h) ** power for h in harmonics)


def _thermal(model: AxisModel, level: Level) -> Effect:
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
    return Effect(dry=ends(t.dry_per_c, t.dry_per_s), viscous=ends(t.viscous_per_c, t.viscous_per_s), told=told)


def _drift(per_s: float, ends_after_s: float | None) -> float:
    """What a drift adds to a factor at its end; one without an end is followed as far as DRIFT."""
    if ends_after_s is not None:
        return per_s * ends_after_s
    return 0.0 if per_s == 0.0 else (DRIFT[0] if per_s < 0.0 else DRIFT[1]) - 1.0


def _lasts(per_s: float) -> str:
    return f", drift for {(DRIFT[1] - 1.0) / per_s:.3g} s" if per_s else ""


def _load_dependent(model: AxisModel, level: Level) -> Effect:
    """More dry friction by what is carried; and a part of each change of the command goes into friction at once."""
    f = model.load_dependent_friction
    assert f is not None
    share = min(f.per_command, 0.9)
    more = (share * level.torque_nm + f.per_load * level.load_nm) / (1.0 - share)
    return Effect(dry=(1.0, 1.0 + more / level.least_dry_nm), torque_gain=around(share))


def _position_dependent(model: AxisModel, level: Level) -> Effect:
    """Friction over position; its slope is a stiffness, of either sign by the direction of motion."""
    f = model.position_dependent_friction
    assert f is not None
    waves, lows = sums(f.harmonics, 0), sum(min(b.factor, 0.0) for b in f.bumps)
    highs = sum(max(b.factor, 0.0) for b in f.bumps)
    steep = sums(f.harmonics, 1) + sum(abs(b.factor) * STEEPEST_OF_BELL / b.width for b in f.bumps)
    slope = steep * level.friction.gain * level.friction.largest(level.top_rad_s)
    return Effect(dry=(max(1.0 - waves + lows, SMALLEST_FACTOR), 1.0 + waves + highs), position_slope=(-slope, slope))


def _ripple(model: AxisModel, level: Level) -> Effect:
    """A gain over position; with the torque that is asked for it is a stiffness as well."""
    assert model.torque_ripple is not None
    waves = model.torque_ripple.harmonics
    slope = sums(waves, 1) * level.torque_nm
    return Effect(torque_gain=around(sums(waves, 0)), position_slope=(-slope, slope))


def _inertia(model: AxisModel, level: Level) -> Effect:
    """M(x), and dM/dx*v^2/2 at top speed with its slopes over position and velocity."""
    assert model.position_dependent_inertia is not None
    waves, behind = model.position_dependent_inertia.harmonics, model.two_mass
    mass = behind.load_inertia if behind else model.inertia
    slope = 0.5 * mass * sums(waves, 2) * level.top_rad_s**2
    viscous = mass * sums(waves, 1) * level.top_rad_s
    share = sums(waves, 0) * mass / model.inertia
    return Effect(inertia=around(share), position_slope=(-slope, slope), more_viscous=(-viscous, viscous))


def _eccentricity(model: AxisModel, _level: Level) -> Effect:
    """Position and velocity are read by the same factor, which the loop cannot tell from torque gain."""
    assert model.encoder_eccentricity is not None
    return Effect(torque_gain=around(sums(model.encoder_eccentricity.harmonics, 1)))


def _saturation(model: AxisModel, level: Level) -> Effect:
    """A soft limit lowers the gain near it: of limit*tanh(u/limit) 1 - (torque/limit)^2 is left."""
    s = model.torque_saturation
    assert s is not None
    share = min(level.torque_nm / min(s.limit, s.negative_limit or s.limit), 1.0)
    return Effect(torque_gain=(max(1.0 - share**2, SMALLEST_FACTOR), 1.0)) if s.shape == "tanh" else Effect()


def _gain_by_sign(model: AxisModel, level: Level) -> Effect:
    """Commands of one sign do more than those of the other; the loop stands on the mean of both."""
    g = model.torque_gain
    assert g is not None
    ends = sorted((g.factor / level.friction.gain, (g.negative_factor or g.factor) / level.friction.gain))
    return Effect(torque_gain=(ends[0], ends[1]))


def _offset_drift(model: AxisModel, level: Level) -> Effect:
    """A constant torque closes no loop: it is load, and until when a drift without an end is followed is told."""
    drift = model.offset_drift
    assert drift is not None
    end_nm = drifted_offset(model, level)
    if end_nm == 0.0:
        return Effect()
    lasts = f" after {end_nm / drift.per_s:.3g} s" if drift.time_s is None else ""
    return Effect(told=f"offset drifts by {end_nm:.2g} N*m{lasts}")


def _residual(model: AxisModel, _level: Level) -> Effect:
    """Tables over position and velocity by their steepest pieces; one over time acts from outside."""
    r = model.residual
    assert r is not None
    return Effect(position_slope=_steepest(r.position), more_viscous=_steepest(r.velocity))


def _steepest(table: fx.Table | None) -> Ends:
    if table is None:
        return NONE
    rows = zip(pairwise(table.grid), pairwise(table.torque), strict=True)
    slopes = [(after - before) / (end - start) for (start, end), (before, after) in rows]
    return min(0.0, *slopes), max(0.0, *slopes)


#: Groups that scale or shift what the loop has in it.
EFFECTS: dict[type[Group], Callable[[AxisModel, Level], Effect]] = {
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


def effects_of(model: AxisModel, level: Level) -> dict[str, Effect]:
    """Every effect that `model` has and that changes something, by its key; torques per unit of torque gain."""
    gain, found = level.friction.gain, {}
    names = {type(group): name for name, group in model.groups()}
    for group, effect in EFFECTS.items():
        if group not in names:
            continue
        e = effect(model, level)
        slope, viscous = ((low / gain, high / gain) for low, high in (e.position_slope, e.more_viscous))
        e = Effect(e.inertia, e.torque_gain, e.dry, e.viscous, slope, viscous, e.told)
        if e != Effect():
            found[names[group]] = e
    return found
