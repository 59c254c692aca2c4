"""Errors of windows that are simulated freely from the recorded state: how far a model is off after a while.

Stands beside the mismatch in the report; the same replay that `servoctl replay` runs.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from servod.axis_model import AxisModel
from servod.diagnose.trace import Trace
from servod.models.replay import Drive, replay

#: Lengths of the windows, s.
HORIZONS_S = (0.25, 1.0)


def window_errors(traces: Sequence[Trace], before: AxisModel, after: AxisModel) -> dict[str, Any]:
    """RMS position error (rad or m) over all recordings: horizon -> before, after."""
    found: dict[str, Any] = {}
    for horizon in HORIZONS_S:
        found[f"{horizon:g}"] = {
            "before": _rms(traces, before, horizon),
            "after": _rms(traces, after, horizon),
        }
    return found


def _rms(traces: Sequence[Trace], model: AxisModel, horizon_s: float) -> float:
    total, rows = 0.0, 0
    for trace in traces:
        drive = trace.drive
        recorded = Drive(drive.t_s - trace.shift_s, drive.torque, drive.position, drive.temperature_c)
        error = replay(model, recorded, horizon_s).error[trace.counts]
        total += float(error @ error)
        rows += len(error)
    return float(np.sqrt(total / max(rows, 1)))
