"""Coordinates over which a mismatch is looked at: what the axis did, and for how long, in every row.

Stands between the traces and the maps of `locate`; units are those of the axis.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servod.formats.model.axis_model import AxisKind, AxisModel
from servod.lab.diagnose.data.trace import Trace
from servod.lab.diagnose.predict.predict import Predictor

Array = NDArray[np.float64]

#: Times since a reversal, and at rest, are told up to here, s.
LONGEST_S = 1.0

#: The joint rests where its speed is below this many of its own errors; a map of rest needs this share of the rows.
REST_ERRORS, LEAST_RESTING = 3.0, 0.02

#: The change of the command is taken over so long, s.
CHANGE_S = 0.01


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
    if float(np.mean(np.isfinite(rest[predictor.counts]))) >= LEAST_RESTING:
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
    """Time since the velocity last changed its sign, s, at most LONGEST_S."""
    turned = np.concatenate([[True], np.diff(np.sign(velocity)) != 0.0])
    return np.minimum(t_s - t_s[_last(turned)], LONGEST_S)


def at_rest(trace: Trace) -> Array:
    """For how long the joint has been at rest, s, at most LONGEST_S; NaN in rows in which it moves."""
    rests = np.abs(trace.velocity) < REST_ERRORS * trace.drive.motion[:, 3]
    begun = _last(np.concatenate([[True], rests[1:] & ~rests[:-1]]))
    held = np.minimum(trace.drive.t_s - trace.drive.t_s[begun], LONGEST_S)
    return np.where(rests, held, np.nan)


def _last(marked: NDArray[np.bool_]) -> NDArray[np.int64]:
    """The last marked row at or before each row."""
    return np.asarray(np.maximum.accumulate(np.where(marked, np.arange(len(marked)), 0)), dtype=np.int64)


def _change(trace: Trace) -> Array:
    """Change of the command per second, over CHANGE_S around each row."""
    from scipy.ndimage import uniform_filter1d

    rows = max(3, round(CHANGE_S / trace.period_s))
    smooth = uniform_filter1d(trace.drive.torque, rows, mode="nearest")
    return np.asarray(np.gradient(smooth) / trace.period_s)


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


def where(coordinate: str, located: Mapping[str, Any]) -> str:
    """Where an effect is strongest, as the end of a sentence: its own coordinate, and recording and time."""
    said = []
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
