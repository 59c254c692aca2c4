"""Windows that are simulated freely, by models of a cross-validation: each judges the rows that it has not seen.

Stands between cross-validation and whoever chooses or judges by what a model predicts. A mismatch is seen one sample
ahead: an observer that is pulled to the encoder hides what carries a simulation away.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from servod.formats.model.axis_model import AxisModel
from servod.lab.diagnose.data.trace import CheckedTrace
from servod.lab.diagnose.predict.predict import Predictor
from servod.lab.diagnose.select.selection import Fold, HeldOutErrors
from servod.lab.diagnose.settings import SETTINGS
from servod.lab.simulate.replay import Drive, replay

Array = NDArray[np.float64]


def free_run_errors(predictor: Predictor, held: HeldOutErrors, judged: NDArray[np.bool_]) -> Array:
    """RMS of the windows of each length over the rows that are judged, rad or m."""
    errors = (fold_errors(predictor, held.folds, horizon)[judged] for horizon in SETTINGS.validation.horizons_s)
    return np.array([float(np.sqrt(np.mean(error**2))) for error in errors])


def free_run_gain(
    predictor: Predictor, before: HeldOutErrors, after: HeldOutErrors, judged: NDArray[np.bool_]
) -> float:
    """RMS of the shortest windows by fits with the physics added, as a multiple of that by fits without it."""
    with_it, without = (
        fold_errors(predictor, held.folds, SETTINGS.validation.horizons_s[0])[judged] for held in (after, before)
    )
    return float(np.sqrt(np.mean(with_it**2) / max(float(np.mean(without**2)), 1e-30)))


def fold_errors(predictor: Predictor, folds: Sequence[Fold], horizon_s: float) -> Array:
    """Simulated minus recorded position of every row, rad or m; a fold judges the rows that it has not seen."""
    error = np.zeros(len(predictor.counts))
    for fold in folds:
        for index, (trace, part) in enumerate(zip(predictor.traces, predictor.slices, strict=True)):
            rows, model = fold.rows[part], fold.of(index)
            if rows.any():
                error[part][rows] = replay(model, _drive(trace, model), horizon_s).error[rows]
    return error


def _drive(trace: CheckedTrace, model: AxisModel) -> Drive:
    """The recording on the time that the model's windows of disturbance are in: shifted, where one was fitted."""
    if model.disturbance is not None and model.disturbance.windows:
        return trace.drive
    return trace.at_its_own_times
