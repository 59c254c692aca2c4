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
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args, get_type_hints

import yaml
from pydantic import Field, model_validator

from servod.common.errors import BadInput
from servod.common.yaml import Dumper, Strict
from servod.formats.kinds import FileKind, load_kind
from servod.formats.model import effects as fx
from servod.formats.model import friction as fr
from servod.formats.model.drive import DriveLaw
from servod.formats.model.identified import Identified
from servod.formats.model.keys import Group, Harmonic, Harmonics
from servod.kernels.physics.layout import PackedPlant, PlantParameters

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

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
    drive: DriveLaw | None = None
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
    def lag_s(self) -> float:
        """Time constant of the torque behind that delay, in s."""
        return self.actuator_lag.time_constant_s if self.actuator_lag else 0.0

    @property
    def acts_after_s(self) -> float:
        """Delay and lag between a command and its torque, in s."""
        return self.total_delay_s + self.lag_s

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
    return load_kind(path, FileKind.MODEL, AxisModel)


def load_rotary_model(path: str | Path) -> AxisModel:
    """An axis model for a drive that turns, real or virtual. Raises BadInput, also for a linear axis."""
    return rotary(load_axis_model(path), str(path))


def rotary(model: AxisModel, where: str) -> AxisModel:
    """`model` itself; raises BadInput for a linear axis, whose N and m a drive would take for N*m and rad."""
    if model.axis is not AxisKind.ROTARY:
        raise BadInput(f"{where}: axis", model.axis.value, "rotary: drive, encoder and loop count turns")
    return model


# --- Parameters of the kernels ---------------------------------------------------------------------------------------
# Turns an axis model into the parameters of the physics kernels (`servod.kernels.physics.layout`). Off the control
# path.


#: Friction torque below which the bristle equation divides by nothing sensible; far under any real joint's.
SMALLEST_DRY_FRICTION = 1e-12

#: The parameters and their types: float, int for places in tables, bool.
KINDS: dict[str, type[float]] = get_type_hints(PlantParameters)


class _Packer:
    """The parameters while they are filled; tables go one behind the other."""

    def __init__(self) -> None:
        self.values: dict[str, float] = {}
        self.tables: list[float] = []

    def put(self, **numbers: float) -> None:
        """Set parameters by their name."""
        for name, value in numbers.items():
            self.values[name] = KINDS[name](value)

    def table(self, name: str, rows: Iterable[Sequence[float]]) -> None:
        """Append a table and note its start and its number of rows under `name`."""
        kept = list(rows)
        self.put(**{name: len(self.tables), f"{name}_n": len(kept)})
        for row in kept:
            self.tables.extend(float(number) for number in row)


def pack(model: AxisModel) -> PackedPlant:
    """The parameters of `model` as the kernels take them, SI units."""
    packer = _Packer()
    packer.put(delay_s=model.total_delay_s, offset=model.torque_offset)
    if model.offset_drift is not None:
        packer.put(offset_per_s=model.offset_drift.per_s, offset_time_s=model.offset_drift.time_s or 0.0)
    packer.put(complex=any(not group.plain for _, group in model.groups()))
    _friction(packer, model)
    _friction_effects(packer, model)
    _load(packer, model)
    _actuator(packer, model)
    packer.put(start_c=model.start_temperature_c)
    _thermal(packer, model.thermal)
    _position(packer, model)
    _time(packer, model)
    numbers = (packer.values.get(name, kind()) for name, kind in KINDS.items())
    return PackedPlant(PlantParameters._make(numbers), tuple(packer.tables))


def _friction(packer: _Packer, model: AxisModel) -> None:
    law = model.friction
    packer.put(viscous=law.viscous, stribeck_velocity=0.1, stribeck_exponent=2.0)
    if isinstance(law, LocalFriction):
        packer.put(sigma0=law.sigma0, sigma1=law.sigma1, complex=1.0)
        points = list(zip(law.velocities, law.torques, strict=True))
        packer.table("local_positive", [(v, t) for v, t in points if v > 0.0])
        packer.table("local_negative", [(-v, -t) for v, t in reversed(points) if v < 0.0])
        return
    packer.put(coulomb=max(law.coulomb, SMALLEST_DRY_FRICTION), static=max(law.coulomb, SMALLEST_DRY_FRICTION))
    if isinstance(law, LugreFriction):
        packer.put(sigma0=law.sigma0, sigma1=law.sigma1)
    if not isinstance(law, CoulombViscousFriction):
        static = law.coulomb if law.static is None else law.static
        packer.put(static=max(static, SMALLEST_DRY_FRICTION), stribeck_velocity=law.stribeck_velocity)


def _friction_effects(packer: _Packer, model: AxisModel) -> None:
    if model.stribeck is not None:
        given = model.stribeck.model_dump(exclude_none=True)
        packer.put(**{"stribeck_exponent" if key == "exponent" else key: value for key, value in given.items()})
    if model.presliding is not None:
        given = model.presliding.model_dump(exclude_none=True)
        packer.put(**{"sigma1_velocity" if key == "damping_velocity" else key: value for key, value in given.items()})
    packer.put(**(model.asymmetry or fr.Asymmetry()).model_dump())
    nonlinear = model.viscous_nonlinear or fr.ViscousNonlinear()
    packer.put(quadratic=nonlinear.quadratic, cubic=nonlinear.cubic)
    packer.put(power=nonlinear.power, power_exponent=nonlinear.exponent)
    if model.load_dependent_friction is not None:
        carried = model.load_dependent_friction
        packer.put(friction_per_command=carried.per_command, friction_per_load=carried.per_load)


def _load(packer: _Packer, model: AxisModel) -> None:
    packer.put(inertia=model.inertia)
    behind = model.two_mass
    if behind is not None:
        packer.put(inertia=model.inertia - behind.load_inertia, viscous=model.friction.viscous - behind.load_viscous)
        packer.put(**behind.model_dump(exclude={"cubic"}))
    if model.joint_elasticity is not None:
        packer.put(stiffness_cubic=model.joint_elasticity.cubic)
    if model.backlash is not None:
        packer.put(gap=model.backlash.gap)
    gravity = model.gravity or fx.Gravity()
    packer.put(gravity=gravity.amplitude, gravity_phase=gravity.phase)
    spring = model.spring or fx.Spring()
    packer.put(spring=spring.stiffness, spring_rest=spring.rest, spring_cubic=spring.cubic)


def _actuator(packer: _Packer, model: AxisModel) -> None:
    gain = model.torque_gain or fx.TorqueGain()
    negative = gain.factor if gain.negative_factor is None else gain.negative_factor
    packer.put(gain_positive=gain.factor, gain_negative=negative)
    limit = model.torque_saturation
    if limit is not None:
        packer.put(limit_positive=limit.limit, limit_negative=limit.negative_limit or limit.limit)
        packer.put(limit_soft=limit.shape is fx.LimitShape.TANH)
    if model.actuator_lag is not None:
        packer.put(lag_s=model.actuator_lag.time_constant_s, slew=model.actuator_lag.slew_per_s or 0.0)


def _thermal(packer: _Packer, thermal: fr.Thermal | None) -> None:
    packer.put(ambient_c=25.0, cooling_s=600.0)
    if thermal is None:
        return
    packer.put(thermal=1.0, thermal_exponential=thermal.shape is fr.ThermalShape.EXPONENTIAL)
    packer.put(dry_per_c=thermal.dry_per_c, viscous_per_c=thermal.viscous_per_c, reference_c=thermal.reference_c)
    packer.put(dry_per_s=thermal.dry_per_s, viscous_per_s=thermal.viscous_per_s)
    packer.put(drift_time_s=thermal.drift_time_s or 0.0, ambient_c=thermal.ambient_c)
    packer.put(heating_c_per_j=thermal.heating_c_per_j, cooling_s=thermal.cooling_s)


def _rows(harmonics: Iterable[Harmonic]) -> list[tuple[float, float, float]]:
    return [(h.amplitude, wave_number(h), h.phase) for h in harmonics]


def _position(packer: _Packer, model: AxisModel) -> None:
    groups: dict[str, Harmonics | fr.PositionDependentFriction | None] = {
        "cogging": model.cogging,
        "ripple": model.torque_ripple,
        "position_friction": model.position_dependent_friction,
        "position_inertia": model.position_dependent_inertia,
        "eccentricity": model.encoder_eccentricity,
    }
    for name, group in groups.items():
        packer.table(name, _rows(group.harmonics) if group else [])
    friction = model.position_dependent_friction
    packer.table("bumps", [(b.position, b.width, b.factor) for b in friction.bumps] if friction else [])


def _time(packer: _Packer, model: AxisModel) -> None:
    windows = model.disturbance.windows if model.disturbance else ()
    packer.table("disturbance", [(w.start_s, w.end_s, w.torque, w.frequency_hz, w.phase) for w in windows])
    residual = model.residual or fx.Residual()
    for name in ("position", "velocity", "time"):
        table: fx.TorqueMap | None = getattr(residual, name)
        packer.table(f"residual_{name}", zip(table.grid, table.torque, strict=True) if table else [])
