"""A shorter set of data for first rounds: of every recording the stretch where most is left to explain.

Stands between the predictor and the trials; what is tried on it and promises anything is fitted on everything after.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from servod.formats.model.axis_model import AxisModel
from servod.lab.diagnose.data.trace import Trace
from servod.lab.diagnose.predict.predict import SETTLING, Predictor
from servod.lab.simulate.replay import Drive

Array = NDArray[np.float64]

#: Share of each recording that is kept, and the least that is, s.
KEPT, LEAST_S = 0.35, 4.0


def shortened(predictor: Predictor, nominal: AxisModel, mismatch: Array) -> Predictor:
    """A predictor on the stretch of each recording with the greatest power of `mismatch`; the same observer."""
    traces = [
        _cut(trace, mismatch[part], SETTLING / predictor.rate)
        for trace, part in zip(predictor.traces, predictor.slices, strict=True)
    ]
    return Predictor(traces, nominal, predictor.rate)


def _cut(trace: Trace, mismatch: Array, settling_s: float) -> Trace:
    length = max(KEPT * trace.duration_s, LEAST_S) + settling_s
    rows = min(round(length / trace.period_s), len(mismatch))
    power = np.concatenate([[0.0], np.cumsum(mismatch**2)])
    first = int(np.argmax(power[rows:] - power[: len(power) - rows]))
    part = slice(first, first + rows)
    drive = trace.drive
    short = Drive(drive.t_s[part], drive.torque[part], drive.position[part], drive.temperature_c[part])
    return replace(trace, drive=short, counts=trace.counts[part])
