"""Coordinates over which a mismatch is looked at: what the axis did, and for how long, in every row.

Stands between the traces and the maps of `locate`; units are those of the axis.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servod.formats.model.axis_model import AxisKind, AxisModel
from servod.lab.diagnose.data.trace import Trace
from servod.lab.diagnose.predict.predict import Predictor
from servod.lab.diagnose.settings import SETTINGS

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Units:
    """Units of position and torque of an axis; others are made of them."""

    length: str
    force: str


def units(axis: Predictor | AxisModel) -> Units:
    """Units of the axis of a predictor or model."""
    linear = axis.axis is AxisKind.LINEAR if isinstance(axis, AxisModel) else axis.linear
    return Units("m", "N") if linear else Units("rad", "N·m")


def coordinates(predictor: Predictor) -> dict[str, tuple[str, Array]]:
    """Coordinates of every row: name -> (unit, values); NaN where a row has none."""
    traces, unit = predictor.traces, units(predictor)
    x, v, a, u = (predictor.over(name) for name in ("position", "velocity", "acceleration", "torque"))
    found = {
        "time": ("s", running_time(predictor)),
        "position": (unit.length, x),
        "velocity": (f"{unit.length}/s", v),
        "direction": ("1", np.sign(v)),
        "acceleration": (f"{unit.length}/s²", a),
        "load": (unit.force, u),
        "change of the command": (f"{unit.force}/s", np.concatenate([_change(trace) for trace in traces])),
        "time since reversal": ("s", np.concatenate([since_reversal(t.drive.t_s, t.velocity) for t in traces])),
        "position, moving forward": (unit.length, np.where(v > 0.0, x, np.nan)),
        "position, moving back": (unit.length, np.where(v < 0.0, x, np.nan)),
        "load, moving forward": (unit.force, np.where(v > 0.0, u, np.nan)),
        "load, moving back": (unit.force, np.where(v < 0.0, u, np.nan)),
    }
    rest = np.concatenate([at_rest(trace) for trace in traces])
    if float(np.mean(np.isfinite(rest[predictor.counts]))) >= SETTINGS.coordinates.least_resting:
        found["time at rest"] = ("s", rest)
    if all(trace.has_temperature for trace in traces):
        found["temperature"] = ("°C", predictor.over("temperature_c"))
    return found


def running_time(predictor: Predictor) -> Array:
    """Time of every row when the recordings are laid one behind the other, s."""
    begun, parts = 0.0, []
    for trace in predictor.traces:
        parts.append(trace.drive.t_s - trace.drive.t_s[0] + begun)
        begun = float(parts[-1][-1]) + trace.period_s
    return np.concatenate(parts)


def since_reversal(t_s: Array, velocity: Array) -> Array:
    """Time since the velocity last changed its sign, s, up to a longest time."""
    turned = np.concatenate([[True], np.diff(np.sign(velocity)) != 0.0])
    return np.minimum(t_s - t_s[_last(turned)], SETTINGS.coordinates.longest_s)


def at_rest(trace: Trace) -> Array:
    """For how long the joint has been at rest, s, up to a longest time; NaN in rows in which it moves."""
    rests = np.abs(trace.velocity) < SETTINGS.coordinates.rest_errors * trace.drive.motion[:, 3]
    begun = _last(np.concatenate([[True], rests[1:] & ~rests[:-1]]))
    held = np.minimum(trace.drive.t_s - trace.drive.t_s[begun], SETTINGS.coordinates.longest_s)
    return np.where(rests, held, np.nan)


def _last(marked: NDArray[np.bool_]) -> NDArray[np.int64]:
    """The last marked row at or before each row."""
    return np.asarray(np.maximum.accumulate(np.where(marked, np.arange(len(marked)), 0)), dtype=np.int64)


def _change(trace: Trace) -> Array:
    """Change of the command per second, over a short time around each row."""
    from scipy.ndimage import uniform_filter1d

    rows = max(3, round(SETTINGS.coordinates.change_s / trace.period_s))
    smooth = uniform_filter1d(trace.drive.torque, rows, mode="nearest")
    return np.asarray(np.gradient(smooth) / trace.period_s)


# Where each effect shows best: the coordinate of its picture, and how to say where it acts.
#
# Stands between `locate` and the report; one line for each effect, and position for one that is not listed.


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
