"""The numbers that the physics kernels work on, by name: parameters of an axis, its state, and the tables beside them.

Stands under every kernel of `servod.kernels.physics`, which take them as `p`, `s` and `tables`. In pure Python `p` and
`s` are the classes below, compiled they are records of the same names (`servod.kernels.physics.compiled.record`), so
that one source runs on both. `servod.formats.model.axis_model` fills `p` and `tables` from an axis model. SI units in
joint coordinates throughout; for a linear axis read N for N*m, m for rad, kg for kg*m^2.

A record goes from kernel to kernel as one pointer, and an inner step takes what it took with flat arrays (41 ns plain,
136 with every effect). A NamedTuple of 54 floats and 12 tables would go by value, and numba takes 8 to 14 us to accept
one from Python, where an array takes 0.1; a bare record takes 13, one out of an array of one 0.15. Hence one record of
both, in an array of one, where calls are short (`PlantRecord`, `compiled.entry`). All kernels together compile within a
tenth of the time of flat arrays; with such an entry around every one of them it was a quarter more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple


class PlantParameters(NamedTuple):
    """The parameters of an axis; what a model does not have stays 0."""

    inertia: float = 0.0  # motor side; the whole inertia when there is one mass
    sigma0: float = 0.0  # bristle stiffness; 0 = no presliding, set-valued Coulomb friction
    sigma1: float = 0.0
    sigma1_velocity: float = 0.0  # 0 = bristle damping does not fade with speed
    viscous: float = 0.0  # motor side
    coulomb: float = 0.0
    static: float = 0.0
    stribeck_velocity: float = 0.0
    stribeck_exponent: float = 0.0
    gravity: float = 0.0
    gravity_phase: float = 0.0
    offset: float = 0.0
    offset_per_s: float = 0.0  # 0 = the offset does not drift
    offset_time_s: float = 0.0  # 0 = its drift has no end
    delay_s: float = 0.0
    complex: bool = False  # some effect is present that the plain loop leaves out
    positive_dry: float = 0.0  # factors of dry and viscous friction by direction
    negative_dry: float = 0.0
    positive_viscous: float = 0.0
    negative_viscous: float = 0.0
    quadratic: float = 0.0
    cubic: float = 0.0
    power: float = 0.0
    power_exponent: float = 0.0
    friction_per_command: float = 0.0
    friction_per_load: float = 0.0
    spring: float = 0.0
    spring_rest: float = 0.0
    spring_cubic: float = 0.0
    load_inertia: float = 0.0  # 0 = one mass
    stiffness: float = 0.0
    stiffness_cubic: float = 0.0
    damping: float = 0.0
    load_viscous: float = 0.0  # of the whole viscous friction, the part behind the joint's spring
    gap: float = 0.0
    gain_positive: float = 0.0
    gain_negative: float = 0.0
    limit_positive: float = 0.0  # 0 = no limit
    limit_negative: float = 0.0
    limit_soft: bool = False
    lag_s: float = 0.0
    slew: float = 0.0  # 0 = no limit of the torque's rate
    thermal: bool = False
    dry_per_c: float = 0.0
    viscous_per_c: float = 0.0
    reference_c: float = 0.0
    thermal_exponential: bool = False
    ambient_c: float = 0.0
    heating_c_per_j: float = 0.0
    cooling_s: float = 0.0
    dry_per_s: float = 0.0
    viscous_per_s: float = 0.0
    drift_time_s: float = 0.0
    start_c: float = 0.0  # temperature before the first step where none is recorded
    # tables: first index in `tables` and number of rows
    cogging: int = 0
    cogging_n: int = 0
    ripple: int = 0
    ripple_n: int = 0
    position_friction: int = 0
    position_friction_n: int = 0
    bumps: int = 0
    bumps_n: int = 0
    position_inertia: int = 0
    position_inertia_n: int = 0
    eccentricity: int = 0
    eccentricity_n: int = 0
    disturbance: int = 0
    disturbance_n: int = 0
    local_positive: int = 0
    local_positive_n: int = 0
    local_negative: int = 0
    local_negative_n: int = 0
    residual_position: int = 0
    residual_position_n: int = 0
    residual_velocity: int = 0
    residual_velocity_n: int = 0
    residual_time: int = 0
    residual_time_n: int = 0


class PackedPlant(NamedTuple):
    """An axis model as the kernels take it; `tables` has the rows of all tables, one behind the other."""

    p: PlantParameters
    tables: tuple[float, ...]


#: Rows of all tables as a kernel reads them: a tuple, or a float64 array when compiled.
Tables = Sequence[float]


@dataclass(slots=True)
class PlantState:
    """What moves; the command delay line, whose length the delay sets, goes beside it."""

    position: float = 0.0  # motor side
    velocity: float = 0.0
    bristle: float = 0.0  # z, rad
    load_position: float = 0.0  # follows the motor when there is one mass
    load_velocity: float = 0.0
    torque: float = 0.0  # torque behind actuator lag and limits, before ripple
    temperature_c: float = 0.0
    time_s: float = 0.0
    first_s: float = 0.0  # time of the first step: drifts count from here, t_s of a recording may count from 1970
    friction: float = 0.0  # friction torque of the last step
    head: int = 0  # where the delay line is written next


class PlantRecord(NamedTuple):
    """Parameters and state as one record, which a kernel that is called from Python takes (`compiled.entry`)."""

    p: PlantParameters
    s: PlantState
