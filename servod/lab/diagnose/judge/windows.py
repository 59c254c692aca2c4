"""Errors of windows that are simulated freely from the recorded state: how far a model is off after a while.

Stands beside the mismatch in the report; the same replay that `servoctl replay` runs. Every row is judged by a model
that was fitted without it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servod.formats.model.axis_model import AxisModel
from servod.lab.diagnose.data.trace import Trace
from servod.lab.diagnose.judge.held_out import Fold, HeldOut
from servod.lab.diagnose.predict.predict import Predictor
from servod.lab.simulate.replay import Drive, replay

Array = NDArray[np.float64]

#: Lengths of the windows, s.
HORIZONS_S = (0.25, 1.0)


@dataclass(frozen=True)
class WindowErrors:
    """Simulated minus recorded position (rad or m) of every row, in windows of `horizon_s`.

    `nominal` is by the model as it came, `recalibrated` by its own parameters fitted elsewhere, `after` by the model
    with the physics added, fitted elsewhere.
    """

    horizon_s: float
    nominal: Array
    recalibrated: Array
    after: Array

    def document(self, judged: NDArray[np.bool_]) -> dict[str, float]:
        """RMS over the rows that are judged."""
        values = {"before": self.nominal, "recalibrated": self.recalibrated, "after": self.after}
        return {name: float(np.sqrt(np.mean(error[judged] ** 2))) for name, error in values.items()}


def window_errors(
    predictor: Predictor, nominal: AxisModel, base: Sequence[Fold], after: Sequence[Fold]
) -> list[WindowErrors]:
    """Errors for every horizon; each fold's model judges the rows that it has not seen."""
    whole = [Fold(np.ones(len(predictor.counts), dtype=bool), (nominal,))]
    return [
        WindowErrors(horizon, *(_errors(predictor, folds, horizon) for folds in (whole, base, after)))
        for horizon in HORIZONS_S
    ]


def foretold(predictor: Predictor, before: HeldOut, after: HeldOut, judged: NDArray[np.bool_]) -> float:
    """RMS of the shortest windows by fits with the physics added, as a multiple of that by fits without it."""
    with_it, without = (_errors(predictor, held.folds, HORIZONS_S[0])[judged] for held in (after, before))
    return float(np.sqrt(np.mean(with_it**2) / max(float(np.mean(without**2)), 1e-30)))


def windows_document(errors: Sequence[WindowErrors], predictor: Predictor, judged: NDArray[np.bool_]) -> dict[str, Any]:
    """RMS errors by horizon over the rows that are judged, of all recordings and of each."""
    found: dict[str, Any] = {}
    for window in errors:
        entry: dict[str, Any] = {"unit": "m" if predictor.linear else "rad", **window.document(judged)}
        entry["recordings"] = {
            trace.name: window.document(_within(judged, part))
            for trace, part in zip(predictor.traces, predictor.slices, strict=True)
            if judged[part].any()
        }
        found[f"{window.horizon_s:g}"] = entry
    return found


def _within(judged: NDArray[np.bool_], part: slice) -> NDArray[np.bool_]:
    inside = np.zeros_like(judged)
    inside[part] = judged[part]
    return inside


def _errors(predictor: Predictor, folds: Sequence[Fold], horizon_s: float) -> Array:
    error = np.zeros(len(predictor.counts))
    for fold in folds:
        for index, (trace, part) in enumerate(zip(predictor.traces, predictor.slices, strict=True)):
            rows, model = fold.rows[part], fold.of(index)
            if rows.any():
                error[part][rows] = replay(model, _drive(trace, model), horizon_s).error[rows]
    return error


def _drive(trace: Trace, model: AxisModel) -> Drive:
    """The recording on the time that the model's windows of disturbance are in: shifted, where one was fitted."""
    if model.disturbance is not None and model.disturbance.windows:
        return trace.drive
    drive = trace.drive
    return Drive(drive.t_s - trace.shift_s, drive.torque, drive.position, drive.temperature_c)
