"""Coordinates over which a mismatch is looked at: what the axis did, and for how long, in every row.

Stands between the traces and the maps of `locate`; units are those of the axis.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from servod.formats.model.axis_model import AxisKind, AxisModel
from servod.lab.diagnose.data.trace import CheckedTrace
from servod.lab.diagnose.predict.predict import Predictor
from servod.lab.diagnose.result import Units
from servod.lab.diagnose.settings import SETTINGS

Array = NDArray[np.float64]


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


def at_rest(trace: CheckedTrace) -> Array:
    """For how long the joint has been at rest, s, up to a longest time; NaN in rows in which it moves."""
    rests = np.abs(trace.velocity) < SETTINGS.coordinates.rest_errors * trace.drive.motion[:, 3]
    begun = _last(np.concatenate([[True], rests[1:] & ~rests[:-1]]))
    held = np.minimum(trace.drive.t_s - trace.drive.t_s[begun], SETTINGS.coordinates.longest_s)
    return np.where(rests, held, np.nan)


def _last(marked: NDArray[np.bool_]) -> NDArray[np.int64]:
    """The last marked row at or before each row."""
    return np.asarray(np.maximum.accumulate(np.where(marked, np.arange(len(marked)), 0)), dtype=np.int64)


def _change(trace: CheckedTrace) -> Array:
    """Change of the command per second, over a short time around each row."""
    from scipy.ndimage import uniform_filter1d

    rows = max(3, round(SETTINGS.coordinates.change_s / trace.period_s))
    smooth = uniform_filter1d(trace.drive.torque, rows, mode="nearest")
    return np.asarray(np.gradient(smooth) / trace.period_s)
