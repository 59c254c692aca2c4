"""What configuration, axis model and gain set say of the joint's worst: what a stop is reckoned from.

Beside the data path, before the bring-up; below `stopping`, which makes a statement of it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from servod.common.errors import BadInput
from servod.formats.config import AxisConfig
from servod.formats.gains.gain_set import load_gains
from servod.formats.model.axis_model import AxisKind, AxisModel, load_axis_model

#: So much of a model's friction counts: it falls with warmth, wear and grease, and is that of the day of measuring.
_FRICTION_SHARE = 0.5
#: A model's inertia may be off by so much, either way.
_INERTIA_SHARE = 0.1
#: Of a model these change what a stop takes, and no figure here knows them.
_NOT_RECKONED = (
    *("position_dependent_friction", "load_dependent_friction", "viscous_nonlinear", "thermal", "disturbance"),
    *("offset_drift", "residual", "backlash", "joint_elasticity"),
)
#: Loads over position are looked at in so many places of the range.
_POSITIONS = 256


@dataclass(frozen=True)
class JointBounds:
    """What is known of the joint's worst, and from where; `assumed` is what nobody states.

    Inertias, friction and loads are those of a joint that takes the command as its torque: where one of the drive gives
    `torque_factor` of it, they are so much smaller. `brake_nm` is the most command that acts, `late_s` how long torque
    goes on after its command.
    """

    least_inertia: float
    most_inertia: float
    friction_nm: float
    viscous: float
    load_min_nm: float
    load_max_nm: float
    source: str
    assumed: tuple[str, ...]
    torque_factor: float = 1.0
    brake_nm: float = math.inf
    late_s: float = 0.0


def joint_of(config: AxisConfig) -> JointBounds | None:
    """What configuration, model and gain set say of the joint's worst; None where its inertia is nowhere.

    Raises BadInput when a file that is named cannot be read.
    """
    stated = config.stopping
    model, source = _model(config)
    rough = config.wiring_proof.inertia
    nominal = model.inertia if model is not None else rough
    if nominal is None and stated.least_inertia is None and stated.most_inertia is None:
        return None
    varies = sum(abs(wave.amplitude) for wave in model.position_dependent_inertia.harmonics) if (
        model is not None and model.position_dependent_inertia is not None
    ) else 0.0  # fmt: skip
    least, most = stated.least_inertia, stated.most_inertia
    if nominal is not None:
        least = least or nominal * (1.0 - varies) * (1.0 - _INERTIA_SHARE)
        most = most or max(nominal * (1.0 + varies) * (1.0 + _INERTIA_SHARE), least)
    least, most = least or most or 0.0, most or least or 0.0
    if least > most:
        raise BadInput("stopping.least_inertia", f"{least:g} kg*m^2", f"at most the most inertia, {most:g} kg*m^2")
    low_nm, high_nm = (0.0, 0.0) if model is None else _loads(model, config)
    rough_nm = _FRICTION_SHARE * (config.wiring_proof.friction_nm or 0.0)
    friction_nm, viscous = (rough_nm, 0.0) if model is None else _least_friction(model)
    assumed = []
    if model is None and stated.least_friction_nm is None and not rough_nm:
        assumed.append("assumed: no friction (stopping.least_friction_nm)")
    if model is None and stated.load_min_nm is None and stated.load_max_nm is None:
        assumed.append("assumed: no load (stopping.load_min_nm, load_max_nm)")
    if nominal is None or None not in (stated.least_inertia, stated.most_inertia):
        source = "the section stopping states it"
    elif stated.model_fields_set & _OF_THE_JOINT:
        source += ", but for what the section stopping states"
    path = _TorquePath.of(model, config)
    inertias_nm = (least, most, friction_nm if stated.least_friction_nm is None else stated.least_friction_nm)
    loads_nm = (
        viscous if stated.least_viscous is None else stated.least_viscous,
        low_nm if stated.load_min_nm is None else stated.load_min_nm,
        high_nm if stated.load_max_nm is None else stated.load_max_nm,
    )
    least, most, friction_nm, viscous, low_nm, high_nm = (x / path.factor for x in (*inertias_nm, *loads_nm))
    return JointBounds(
        least, most, friction_nm, viscous, low_nm, high_nm, source, (*assumed, *path.notes),
        path.factor, path.brake_nm, path.late_s,
    )  # fmt: skip


#: What the section `stopping` says of the joint, and no other key of it.
_OF_THE_JOINT = {"least_inertia", "most_inertia", "least_friction_nm", "least_viscous", "load_min_nm", "load_max_nm"}


class _TorquePath(NamedTuple):
    """From the command to the joint's torque, at its worst: the most that a command of 1 gives, the most command that
    still acts, and how much later than its command torque ends."""

    factor: float = 1.0
    brake_nm: float = math.inf
    late_s: float = 0.0
    notes: tuple[str, ...] = ()

    @classmethod
    def of(cls, model: AxisModel | None, config: AxisConfig) -> _TorquePath:
        """By the model; without one torque is the command."""
        if model is None:
            return cls()
        gain, limit, lag = model.torque_gain, model.torque_saturation, model.actuator_lag
        factors = (1.0,) if gain is None else (gain.factor, gain.negative_factor or gain.factor)
        ripple = sum(abs(wave.amplitude) for wave in model.torque_ripple.harmonics) if model.torque_ripple else 0.0
        factor = max(factors) * (1.0 + ripple)
        brake_nm = config.limits.torque_nm * min(factors) * max(0.0, 1.0 - ripple)
        if limit is not None:
            brake_nm = min(brake_nm, limit.limit, limit.negative_limit or limit.limit)
        late_s = max(0.0, model.total_delay_s - config.cycle.period_us * 1e-6)
        if lag is not None:
            late_s += lag.time_constant_s
            late_s += 2.0 * min(brake_nm, config.limits.torque_nm * factor) / lag.slew_per_s if lag.slew_per_s else 0.0
        notes = []
        if late_s > config.stopping.drive_lag_s:
            notes.append(
                f"torque is {1e3 * late_s:.3g} ms late by the model (delay, actuator_lag): these figures reckon with "
                "that, but not whether the drive's own ramp comes to rest with it; try it with the drive"
            )
        if left := [name for name in _NOT_RECKONED if getattr(model, name) is not None]:
            notes.append(f"not in these figures, though the model has it: {', '.join(left)}")
        return cls(factor, brake_nm / factor, late_s, tuple(notes))


def contradictions(config: AxisConfig, model: AxisModel) -> list[str]:
    """What the section `stopping` says of a better joint than the model, in sentences."""
    stated, (low_nm, high_nm) = config.stopping, _loads(model, config)
    dry_nm, viscous = (value / _FRICTION_SHARE for value in _least_friction(model))
    rows = (
        ("least_inertia", stated.least_inertia, model.inertia, 1.0),
        ("most_inertia", stated.most_inertia, model.inertia, -1.0),
        ("least_friction_nm", stated.least_friction_nm, dry_nm, 1.0),
        ("least_viscous", stated.least_viscous, viscous, 1.0),
        ("load_min_nm", stated.load_min_nm, low_nm, 1.0),
        ("load_max_nm", stated.load_max_nm, high_nm, -1.0),
    )
    return [
        f"stopping.{key} {value:g}: the model has {of_model:.3g}; the stopping distance is that of a better joint"
        for key, value, of_model, better in rows
        if value is not None and better * (value - of_model) > 1e-9 + 1e-6 * abs(of_model)
    ]


def _model(config: AxisConfig) -> tuple[AxisModel | None, str]:
    """The axis model that the configuration names, or that its first gain set was designed for."""
    if config.model is not None:
        model = load_axis_model(config.model)
        if model.axis is AxisKind.ROTARY:
            shares = f"{_FRICTION_SHARE:g} of its friction, inertia within {_INERTIA_SHARE:.0%}"
            return model, f"{config.model.name} has it, with {shares}"
    if config.stopping.least_inertia is None and config.gains.initial.is_file():  # a stepped axis brings its own set
        design = load_gains(config.gains.initial).design
        if design is not None and design.model.axis is AxisKind.ROTARY:
            return design.model, f"the design of the first gain set has it, with {_FRICTION_SHARE:g} of its friction"
    return None, f"wiring_proof has it, with {_FRICTION_SHARE:g} of its friction"


def _least_friction(model: AxisModel) -> tuple[float, float]:
    """Dry and viscous friction that can be counted on: of the lesser direction, a share of it."""
    law, ways = model.friction, model.asymmetry
    dry = min(abs(t) - law.viscous * abs(v) for v, t in zip(law.velocities, law.torques, strict=True)) if (
        law.kind == "local"
    ) else law.coulomb  # fmt: skip
    dry_share = viscous_share = 1.0
    if ways is not None:
        dry_share = min(ways.positive_dry, ways.negative_dry)
        viscous_share = min(ways.positive_viscous, ways.negative_viscous)
    return _FRICTION_SHARE * max(dry, 0.0) * dry_share, _FRICTION_SHARE * law.viscous * viscous_share


def _loads(model: AxisModel, config: AxisConfig) -> tuple[float, float]:
    """Least and greatest torque of gravity, spring, offset and cogging over the range; no load is among them."""
    low, span = config.limits.position_min_rad, config.limits.position_max_rad - config.limits.position_min_rad
    either_nm = sum(abs(wave.amplitude) for wave in model.cogging.harmonics) if model.cogging is not None else 0.0
    found = [0.0]
    for n in range(_POSITIONS + 1):
        x, load_nm = low + span * n / _POSITIONS, model.torque_offset
        if model.gravity is not None:
            load_nm -= model.gravity.amplitude * math.sin(x + model.gravity.phase)
        if model.spring is not None:
            stretched = x - model.spring.rest
            load_nm -= model.spring.stiffness * stretched + model.spring.cubic * stretched**3
        found.append(load_nm)
    return min(found) - either_nm, max(found) + either_nm
