"""Axis models drawn from a design's intervals: what the Monte-Carlo runs and the limit-cycle tests simulate.

Stands on the axis model alone; every draw has its own seed, so that any plant of a run can be made again.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from servod.formats.gains.design import SHARES, Uncertainty
from servod.formats.model.axis_model import AxisModel, LocalFriction, LugreFriction
from servod.formats.model.effects import TorqueGain
from servod.formats.model.friction import Asymmetry
from servod.lab.verify.steady_friction import fitted_curves

POSITION_SHARE = 0.2  # half width of the interval of torques over position, which is no part of the LMIs
DIRECTION_SHARE = 0.5  # of the interval of dry friction, drawn for each direction by itself


def drawn(model: AxisModel, uncertainty: Uncertainty, seed: int, index: int) -> AxisModel:
    """Plant number `index`: every uncertain value uniform in its interval, dry friction per direction as well."""
    random = np.random.default_rng([seed, index])
    factor = {name: float(1.0 + random.uniform(-1.0, 1.0) * getattr(uncertainty, name)) for name in SHARES}
    sides = 1.0 + random.uniform(-1.0, 1.0, 2) * DIRECTION_SHARE * uncertainty.dry
    plant = scaled(model, factor, (float(sides[0]), float(sides[1])))
    known = over_position(plant, float(1.0 + random.uniform(-1.0, 1.0) * POSITION_SHARE))
    least = -(model.delay.additional_s if model.delay else 0.0)  # the delay as a whole stays at least 0
    delay_s = max(known.delay_s + float(random.uniform(-1.0, 1.0)) * uncertainty.delay_s, least, 0.0)
    return known.model_copy(update={"delay_s": delay_s})


def over_position(model: AxisModel, factor: float) -> AxisModel:
    """`model` with cogging and gravity times `factor`: what is fed forward never fits to the last."""
    update: dict[str, Any] = {}
    if model.cogging is not None:
        waves = (w.model_copy(update={"amplitude": factor * w.amplitude}) for w in model.cogging.harmonics)
        update["cogging"] = model.cogging.model_copy(update={"harmonics": tuple(waves)})
    if model.gravity is not None:
        update["gravity"] = model.gravity.model_copy(update={"amplitude": factor * model.gravity.amplitude})
    return model.model_copy(update=update)


def scaled(model: AxisModel, factor: dict[str, float], sides: tuple[float, float] = (1.0, 1.0)) -> AxisModel:
    """`model` with its values times `factor` (keys of Uncertainty), dry friction per direction times `sides`."""
    one = dict.fromkeys(SHARES, 1.0) | factor
    asymmetry = model.asymmetry or Asymmetry()
    gain = model.torque_gain or TorqueGain()
    update: dict[str, Any] = {
        "inertia": model.inertia * one["inertia"],
        "friction": _friction(model, one),
        "asymmetry": Asymmetry(
            positive_dry=asymmetry.positive_dry * one["dry"] * sides[0],
            negative_dry=asymmetry.negative_dry * one["dry"] * sides[1],
            positive_viscous=asymmetry.positive_viscous * one["viscous"],
            negative_viscous=asymmetry.negative_viscous * one["viscous"],
        ),
        "torque_gain": gain.model_copy(
            update={
                "factor": gain.factor * one["torque_gain"],
                "negative_factor": gain.negative_factor and gain.negative_factor * one["torque_gain"],
            }
        ),
    }
    if model.presliding is not None:
        p = model.presliding
        own = {"sigma0": p.sigma0 and p.sigma0 * one["stiffness"], "sigma1": p.sigma1 and p.sigma1 * one["damping"]}
        update["presliding"] = p.model_copy(update=own)
    return model.model_copy(update=update)


def fallen(model: AxisModel, friction: LocalFriction, factor: float) -> tuple[float, ...]:
    """The map's torques with the fall of the Stribeck curve times `factor`; its level stays.

    What is fall says the curve that the identification fitted, or else what dry friction has above its least so far.
    """
    fitted, torques = fitted_curves(model), []
    for velocity, torque in zip(friction.velocities, friction.torques, strict=True):
        if fitted is not None:
            fall = fitted[0 if velocity > 0.0 else 1].above_level(abs(velocity))
        else:
            dry = [abs(t) - friction.viscous * abs(v) for v, t in _outwards(friction, velocity)]
            fall = dry[0] - min(dry)
        torques.append(torque + (factor - 1.0) * math.copysign(fall, velocity))
    return tuple(torques)


def _outwards(friction: LocalFriction, velocity: float) -> list[tuple[float, float]]:
    """Nodes (velocity, torque) from `velocity` on to faster ones of its direction."""
    nodes = zip(friction.velocities, friction.torques, strict=True)
    return sorted((node for node in nodes if node[0] * velocity >= velocity * velocity), key=lambda node: abs(node[0]))


def _friction(model: AxisModel, factor: dict[str, float]) -> Any:
    """The friction group with bristle and Stribeck curve scaled."""
    friction: Any = model.friction
    update = {"sigma0": friction.sigma0 * factor["stiffness"], "sigma1": friction.sigma1 * factor["damping"]}
    if isinstance(friction, LugreFriction) and friction.static is not None:
        update["static"] = friction.coulomb + (friction.static - friction.coulomb) * factor["slope"]
    if isinstance(friction, LocalFriction):
        update["torques"] = fallen(model, friction, factor["slope"])
    return friction.model_copy(update=update)
