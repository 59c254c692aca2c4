"""Where each effect shows best: the coordinate of its picture, and what splits its rows.

Stands between the effects and what is drawn and said of them; one line for each effect, and position for one that is
not listed.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class Split(Enum):
    """How rows are told apart in a signature, so that opposite signs do not cancel."""

    NONE = "none"
    DIRECTION = "direction"
    LOAD = "load"


@dataclass(frozen=True)
class Look:
    """The coordinate (a name of `coordinates`) over which an effect is looked at, and what splits its rows."""

    coordinate: str
    split: Split = Split.NONE
    periodic: bool = False


#: Effects whose signature is not a plain curve over position.
LOOKS: dict[str, Look] = {
    "asymmetry": Look("velocity"),
    "stribeck": Look("velocity"),
    "presliding": Look("time since reversal", Split.DIRECTION),
    "viscous_nonlinear": Look("velocity"),
    "load_dependent_friction": Look("load", Split.DIRECTION),
    "position_dependent_friction": Look("position", Split.DIRECTION),
    "cogging": Look("position", periodic=True),
    "torque_ripple": Look("position", Split.LOAD, periodic=True),
    "backlash": Look("time since reversal", Split.DIRECTION),
    "joint_elasticity": Look("acceleration"),
    "torque_gain": Look("load"),
    "torque_saturation": Look("load"),
    "delay": Look("change of the command"),
    "actuator_lag": Look("change of the command"),
    "thermal": Look("time", Split.DIRECTION),
    "inertia": Look("acceleration"),
    "position_dependent_inertia": Look("position", Split.LOAD),
    "encoder_eccentricity": Look("position", Split.DIRECTION, periodic=True),
    "torque_offset": Look("time"),
    "disturbance": Look("time"),
    "offset_drift": Look("time"),
}


def look(effect: str) -> Look:
    """How to look at an effect."""
    return LOOKS.get(effect, Look("position"))
