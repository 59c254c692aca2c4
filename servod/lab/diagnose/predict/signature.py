"""Where each effect shows best: the coordinate of its picture, and how to say where it acts.

Stands between `locate` and the report; one line for each effect, and position for one that is not listed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any


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


#: How a range of a coordinate is said.
_SAID = {
    "position": "at positions from {low} to {high} {unit}",
    "velocity": "at velocities from {low} to {high} {unit}",
    "acceleration": "at accelerations from {low} to {high} {unit}",
    "load": "at commands from {low} to {high} {unit}",
    "change of the command": "where the command changes by {low} to {high} {unit}",
    "time since reversal": "from {low} to {high} {unit} after a reversal",
    "temperature": "from {low} to {high} {unit}",
}


def where(effect: str, located: Mapping[str, Any]) -> str:
    """Where the effect is strongest, as the end of a sentence: its own coordinate, and recording and time."""
    said = []
    coordinate = look(effect).coordinate
    found = located.get(coordinate.replace(" ", "_"))
    if found is not None and coordinate in _SAID:
        ends = {"low": f"{found['from']:.3g}", "high": f"{found['to']:.3g}", "unit": found["unit"]}
        said.append(_SAID[coordinate].format(**ends))
    carries: Mapping[str, float] = located["recordings"]
    most = max(carries, key=lambda name: carries[name])
    window = next((w for w in located["time_windows"] if w["recording"] == most), None)
    if window is not None:
        said.append(f"in {most} from {window['start_s']:.2f} to {window['end_s']:.2f} s")
    return ", most of all ".join(said)
