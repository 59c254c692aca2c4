"""Steady friction of an axis model as the controller sees it: torque commands over velocity, direction by direction.

Stands between the axis model and both synthesis and verification. Everything is divided by the model's torque gain:
what a law must ask for, not what the joint feels. Reads the same kernels as the simulator, so both agree.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from servod.common.errors import BadInput
from servod.formats.model.axis_model import AxisModel, wave_number
from servod.formats.model.identified import IdentifiedValue
from servod.kernels.physics.effects import nonlinear_viscous
from servod.kernels.physics.friction import directed_curve
from servod.kernels.physics.layout import PackedPlant

SLOPE_STEP = 1e-3  # share of the velocity over which slopes are taken


@dataclass(frozen=True, slots=True)
class FittedCurve:
    """The curve F_C + (F_S - F_C)*exp(-(v/v_s)^n) + F_v*v that an identification laid through one direction's map."""

    fall: float
    speed: float
    exponent: float
    viscous: float

    def above_level(self, speed: float) -> float:
        """What the curve has left of its fall at `speed`, above F_C [N*m]."""
        rest: float = self.fall * math.exp(-((speed / self.speed) ** self.exponent))
        return rest

    def slope(self, speed: float) -> float:
        """dF/d|v| at `speed` [N*m*s/rad]."""
        power: float = (speed / self.speed) ** self.exponent
        return self.viscous - self.fall * self.exponent * power * math.exp(-power) / speed


@dataclass(frozen=True, slots=True)
class SteadyFriction:
    """The friction of one axis model over velocity; torques in N*m of command, slopes in N*m*s/rad."""

    packed: PackedPlant
    gain: float
    fitted: tuple[FittedCurve, FittedCurve] | None = None  # of positive and negative velocity, in torques of the joint

    @property
    def inertia(self) -> float:
        """All that moves, per unit of torque gain [kg*m^2]."""
        return (self.packed.p.inertia + self.packed.p.load_inertia) / self.gain

    @property
    def stiffness(self) -> float:
        """Bristle stiffness c0 = sigma0 [N*m/rad]."""
        return self.packed.p.sigma0 / self.gain

    def dry(self, velocity: float) -> float:
        """g(v) > 0 of (18) with asymmetry: what the bristle settles to at steady velocity."""
        return directed_curve(*self.packed, velocity) / self.gain

    def viscous(self, velocity: float) -> float:
        """Viscous coefficient at `velocity`, with asymmetry and what is not a line in it."""
        p = self.packed.p
        side = p.positive_viscous if velocity >= 0.0 else p.negative_viscous
        return max(p.viscous * side + nonlinear_viscous(p, velocity), 0.0) / self.gain

    def torque(self, velocity: float) -> float:
        """Steady friction with the velocity's sign: the friction-velocity map (7)."""
        return math.copysign(self.dry(velocity), velocity) + self.viscous(velocity) * velocity

    def dry_slope(self, velocity: float) -> float:
        """dg/d|v|: below zero where the Stribeck curve falls, which a frozen a_i hides.

        From the fitted curve where there is one: between the nodes of a measured map, one per cent of error is a slope
        of twice what the curve falls with.
        """
        if self.fitted is not None:
            curve = self.fitted[0] if velocity >= 0.0 else self.fitted[1]
            return curve.slope(abs(velocity)) / self.gain - self.viscous(velocity)
        step = SLOPE_STEP * abs(velocity)
        up, down = math.copysign(abs(velocity) + step, velocity), math.copysign(abs(velocity) - step, velocity)
        return (self.dry(up) - self.dry(down)) / (2.0 * step)

    def damping(self, velocity: float) -> float:
        """Bristle damping sigma1 at `velocity`, as the simulator has it."""
        p = self.packed.p
        sigma1 = p.sigma1
        if p.sigma1_velocity > 0.0:
            sigma1 *= math.exp(-((velocity / p.sigma1_velocity) ** 2))
        return sigma1 / self.gain

    def largest(self, speed: float) -> float:
        """Largest steady friction up to `speed` in either direction [N*m]."""
        grid = [speed * 0.001**share for share in (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)]
        return max(abs(self.torque(side * v)) for v in grid for side in (1.0, -1.0))


def steady_friction(model: AxisModel, where: str = "model") -> SteadyFriction:
    """The steady friction of `model`. Raises BadInput when the model has no bristle stiffness to compensate."""
    packed = model.pack()
    if packed.p.sigma0 <= 0.0:
        raise BadInput(f"{where}: friction.kind", model.friction.kind, "a kind with bristle stiffness: lugre or local")
    gain = model.torque_gain
    factor = 1.0 if gain is None else math.sqrt(gain.factor * (gain.negative_factor or gain.factor))
    return SteadyFriction(packed, factor, fitted_curves(model))


def fitted_curves(model: AxisModel) -> tuple[FittedCurve, FittedCurve] | None:
    """The curves of both directions as `model` carries them; None for a model that was not identified."""
    if model.identified is None or model.friction.kind != "local":
        return None
    positive, negative = (_fitted(model.identified.values, side) for side in ("positive", "negative"))
    return (positive, negative) if positive and negative else None


def _fitted(values: dict[str, IdentifiedValue], side: str) -> FittedCurve | None:
    names = [f"{name}_{side}" for name in ("static", "coulomb", "stribeck_velocity", "exponent", "viscous")]
    if not all(name in values for name in names):
        return None
    static, coulomb, speed, exponent, viscous = (values[name].value for name in names)
    return FittedCurve(static - coulomb, speed, exponent, viscous)


# --- Slopes over position --------------------------------------------------------------------------------------------
# How steeply torques over position rise and fall: cogging, gravity and springs act on the feedback as stiffness. What
# is fed forward goes by the reference and closes no loop, so the whole slope stays in the loop, fed forward or not.


SPRING_STRETCH_RAD = 1.0  # at which a stiffening spring is judged


def position_slopes(model: AxisModel, gain: float) -> tuple[float, float]:
    """(most falling, most rising) slope of the resisting torque over position, per unit of torque gain [N*m/rad].

    Bounds: the slopes of all waves are summed as if they met in one place. Both 0.0 without such torques.
    """
    waves = model.cogging.harmonics if model.cogging else ()
    slope = sum(abs(wave.amplitude) * wave_number(wave) for wave in waves)
    slope += abs(model.gravity.amplitude) if model.gravity else 0.0
    spring = model.spring
    stiffness = spring.stiffness + 3.0 * spring.cubic * SPRING_STRETCH_RAD**2 if spring else 0.0
    return -slope / gain, (slope + stiffness) / gain
