"""The axis model file: what simulator, identification, synthesis, diagnosis, daemon and the virtual plant share.

Stands between the file (YAML) and the physics kernels of `servod.kernels.physics`, which take `AxisModel.pack()`.
SI units in joint coordinates: rotary rad and N*m, linear m and N. A model omits what it does not have.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from enum import StrEnum
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import yaml
from pydantic import Field, model_validator

from servod.common.errors import BadInput
from servod.common.yaml import Dumper, Strict, load_model
from servod.formats.model import effects as fx
from servod.formats.model import friction as fr
from servod.formats.model.identified import Identified
from servod.formats.model.keys import Group, Harmonic
from servod.kernels.physics.layout import PackedPlant

NonNegative = Annotated[float, Field(ge=0.0)]
Positive = Annotated[float, Field(gt=0.0)]


class AxisKind(StrEnum):
    """What the axis moves in: rad and N*m, or m and N."""

    ROTARY = "rotary"
    LINEAR = "linear"


class LugreFriction(Strict):
    """LuGre: dz/dt = v - sigma0*|v|/g(v)*z, F = sigma0*z + sigma1*dz/dt + viscous*v, the paper's (18)."""

    kind: Literal["lugre"]
    sigma0: Positive = Field(description="bristle stiffness, N*m/rad")
    sigma1: NonNegative = Field(0.0, description="bristle damping, N*m*s/rad")
    viscous: NonNegative = Field(0.0, description="N*m*s/rad")
    coulomb: Positive = Field(description="N*m")
    static: Positive | None = Field(None, description="N*m; None = coulomb")
    stribeck_velocity: Positive = Field(0.1, description="rad/s")


class CoulombViscousFriction(Strict):
    """F = coulomb*sign(v) + viscous*v; at rest any torque up to coulomb holds."""

    kind: Literal["coulomb_viscous"]
    viscous: NonNegative = Field(0.0, description="N*m*s/rad")
    coulomb: NonNegative = Field(0.0, description="N*m")


class StribeckFriction(Strict):
    """F = g(v)*sign(v) + viscous*v, g(v) = coulomb + (static - coulomb)*exp(-(v/stribeck_velocity)^2); sticks."""

    kind: Literal["stribeck"]
    viscous: NonNegative = Field(0.0, description="N*m*s/rad")
    coulomb: NonNegative = Field(description="N*m")
    static: NonNegative = Field(description="N*m")
    stribeck_velocity: Positive = Field(description="rad/s")


class LocalFriction(Strict):
    """The paper's local sets: steady friction at set velocities of both signs, linear between, a bristle around them.

    g(v) = |torque(v)| - viscous*|v| in dz/dt of LuGre, so that the steady friction is the map (7); outside the map its
    end values are held.
    """

    kind: Literal["local"]
    sigma0: Positive = Field(description="bristle stiffness c0, N*m/rad")
    sigma1: NonNegative = Field(0.0, description="bristle damping, N*m*s/rad")
    viscous: NonNegative = Field(0.0, description="d0, the part of the map that is viscous, N*m*s/rad")
    velocities: tuple[float, ...] = Field(min_length=2, max_length=512, description="rad/s, ascending, without 0")
    torques: tuple[float, ...] = Field(min_length=2, max_length=512, description="N*m, with the velocity's sign")

    @model_validator(mode="after")
    def _is_a_map(self) -> LocalFriction:
        if len(self.velocities) != len(self.torques):
            raise ValueError("as many torques as velocities")
        if any(a >= b for a, b in zip(self.velocities, self.velocities[1:], strict=False)):
            raise ValueError("ascending velocities")
        if not self.velocities[0] < 0.0 < self.velocities[-1] or 0.0 in self.velocities:
            raise ValueError("velocities of both signs, without 0")
        if any(v * t <= 0.0 for v, t in zip(self.velocities, self.torques, strict=True)):
            raise ValueError("torques with the sign of their velocity")
        return self


Friction = Annotated[
    LugreFriction | CoulombViscousFriction | StribeckFriction | LocalFriction, Field(discriminator="kind")
]


class AxisModel(Strict):
    """One axis as physics: its basic keys, and one optional group of keys for each effect."""

    axis: AxisKind = AxisKind.ROTARY
    inertia: Positive = Field(description="all that moves: kg*m^2, kg when linear")
    delay_s: float = Field(0.001, ge=0.0, le=0.25, description="command to torque")
    friction: Friction
    gravity: fx.Gravity | None = None
    torque_offset: float = Field(0.0, description="N*m beside the command, with the command's sign")
    asymmetry: fr.Asymmetry | None = None
    stribeck: fr.Stribeck | None = None
    presliding: fr.Presliding | None = None
    viscous_nonlinear: fr.ViscousNonlinear | None = None
    load_dependent_friction: fr.LoadDependentFriction | None = None
    position_dependent_friction: fr.PositionDependentFriction | None = None
    cogging: fx.Cogging | None = None
    torque_ripple: fx.TorqueRipple | None = None
    spring: fx.Spring | None = None
    backlash: fx.Backlash | None = None
    joint_elasticity: fx.JointElasticity | None = None
    torque_gain: fx.TorqueGain | None = None
    torque_saturation: fx.TorqueSaturation | None = None
    delay: fx.Delay | None = None
    actuator_lag: fx.ActuatorLag | None = None
    thermal: fr.Thermal | None = None
    position_dependent_inertia: fx.PositionDependentInertia | None = None
    encoder_eccentricity: fx.EncoderEccentricity | None = None
    disturbance: fx.Disturbance | None = None
    offset_drift: fx.OffsetDrift | None = None
    residual: fx.Residual | None = None
    noise: fx.Noise | None = None
    identified: Identified | None = Field(None, description="what was measured, with 95 % intervals; no physics")

    @model_validator(mode="after")
    def _shares_fit(self) -> AxisModel:
        behind = self.two_mass
        if self.backlash is not None and behind is None:
            raise ValueError("backlash.load_inertia and backlash.stiffness, or a joint_elasticity beside backlash")
        if behind is not None and behind.load_inertia >= self.inertia:
            raise ValueError("load_inertia less than inertia, which holds both masses")
        if behind is not None and behind.load_viscous > self.friction.viscous:
            raise ValueError("load_viscous at most friction.viscous, which holds both parts")
        return self

    @model_validator(mode="after")
    def _keys_have_meaning(self) -> AxisModel:
        """Refuse keys that the friction law, the kind of axis or a group beside would leave without effect."""
        kind, bristle = self.friction.kind, self.presliding
        if self.stribeck is not None and kind == "local":
            raise ValueError("stribeck: another kind than local, whose map has the curve in it")
        if bristle is not None and bristle.sigma0 is None and kind in {"coulomb_viscous", "stribeck"}:
            raise ValueError(f"presliding.sigma0, as friction of kind {kind} has no bristle")
        if self.backlash is not None and self.joint_elasticity is not None:
            for key in ("load_inertia", "stiffness", "damping", "load_viscous"):
                if key in self.backlash.model_fields_set:
                    raise ValueError(f"backlash.{key} not beside joint_elasticity, whose own holds")
        return self

    @model_validator(mode="after")
    def _harmonics_fit(self) -> AxisModel:
        wrong = "periods_per_metre" if self.axis is AxisKind.ROTARY else "periods_per_turn"
        for name, group in self.groups():
            if any(getattr(wave, wrong) is not None for wave in group.waves):
                raise ValueError(f"{name}: no {wrong} on a {self.axis.value} axis")
        self._sums_under_one(1, "slopes amplitude*n")
        return self

    @model_validator(mode="after")
    def _numbers_make_sense(self) -> AxisModel:
        if self.total_delay_s < 0.0:
            raise ValueError("delay_s + delay.additional_s at least 0")
        self._sums_under_one(0, "amplitudes")
        return self

    def _sums_under_one(self, power: int, what: str) -> None:
        for name, group in self.groups():
            if group.under_one != power:
                continue
            if sum(abs(wave.amplitude) * wave_number(wave) ** power for wave in group.waves) >= 1.0:
                raise ValueError(f"{name}: {what} that sum to less than 1")

    def groups(self) -> Iterator[tuple[str, Group]]:
        """The groups of keys that this model has, each with its name, in the order of the file."""
        for name in _group_names(type(self)):
            found = getattr(self, name)
            if found is not None:
                yield name, found

    @property
    def total_delay_s(self) -> float:
        """Command to torque, `delay_s` and the effect `delay` together, in s."""
        return self.delay_s + (self.delay.additional_s if self.delay else 0.0)

    @property
    def start_temperature_c(self) -> float:
        """Joint temperature before anything has moved or been measured, in degC."""
        if self.noise is not None and self.noise.temperature_c is not None:
            return self.noise.temperature_c
        return (self.thermal or fr.Thermal()).ambient_c

    @property
    def two_mass(self) -> fx.TwoMass | None:
        """What is behind the joint's spring or gap; None for a rigid joint."""
        if self.joint_elasticity is not None:
            return self.joint_elasticity
        gap = self.backlash
        if gap is None or gap.load_inertia is None or gap.stiffness is None:
            return None
        return fx.TwoMass(
            load_inertia=gap.load_inertia,
            stiffness=gap.stiffness,
            damping=gap.damping,
            load_viscous=gap.load_viscous,
        )

    def pack(self) -> PackedPlant:
        """The model as the kernels take it (`servod.kernels.physics.layout`)."""
        from servod.formats.model.pack import pack

        return pack(self)


@cache
def _group_names(model: type[AxisModel]) -> tuple[str, ...]:
    """Keys of a model under which a group may stand."""
    kinds = {name: get_args(field.annotation) for name, field in model.model_fields.items()}
    return tuple(n for n, found in kinds.items() if any(isinstance(k, type) and issubclass(k, Group) for k in found))


def axis_model_yaml(model: AxisModel) -> str:
    """The model as YAML text that `load_axis_model` reads back to an equal model; lists of numbers in one line."""
    plain = model.model_dump(mode="json", exclude_none=True, exclude_defaults=True)
    return yaml.dump(plain, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=120)


class _Dumper(Dumper):
    """Writes lists of numbers, and single values with their interval, in one line."""

    def represent_sequence(self, tag: str, sequence: Any, flow_style: bool | None = None) -> yaml.SequenceNode:
        return super().represent_sequence(tag, sequence, flow_style or not any(isinstance(i, dict) for i in sequence))

    def represent_mapping(self, tag: str, mapping: Any, flow_style: bool | None = None) -> yaml.MappingNode:
        in_one_line = isinstance(mapping, dict) and {"value", "low", "high"} <= set(mapping)
        return super().represent_mapping(tag, mapping, in_one_line or flow_style)


def wave_number(harmonic: Harmonic) -> float:
    """n of sin(n*x + phase), in 1/rad or 1/m."""
    if harmonic.periods_per_turn is not None:
        return harmonic.periods_per_turn
    return 2.0 * math.pi * (harmonic.periods_per_metre or 0.0)


def load_axis_model(path: str | Path) -> AxisModel:
    """Read and check an axis model file. Raises BadInput (file, key, found, allowed)."""
    return load_model(path, AxisModel)


def load_rotary_model(path: str | Path) -> AxisModel:
    """An axis model for a drive that turns, real or virtual. Raises BadInput, also for a linear axis."""
    return rotary(load_axis_model(path), str(path))


def rotary(model: AxisModel, where: str) -> AxisModel:
    """`model` itself; raises BadInput for a linear axis, whose N and m a drive would take for N*m and rad."""
    if model.axis is not AxisKind.ROTARY:
        raise BadInput(f"{where}: axis", model.axis.value, "rotary: drive, encoder and loop count turns")
    return model
