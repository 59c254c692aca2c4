"""Turns an axis model into the parameters of the physics kernels (`servod.kernels.physics.layout`).

Stands between `servod.formats.model.axis_model` (what is in the file) and `servod.kernels.physics` (what is
computed); off the control path.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, get_type_hints

from servod.formats.model import effects as fx
from servod.formats.model import friction as fr
from servod.formats.model.axis_model import AxisModel, CoulombViscousFriction, LocalFriction, LugreFriction, wave_number
from servod.formats.model.keys import Harmonic, Harmonics
from servod.kernels.physics.layout import PackedPlant, PlantParameters

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

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
        table: fx.Table | None = getattr(residual, name)
        packer.table(f"residual_{name}", zip(table.grid, table.torque, strict=True) if table else [])
