"""Errors of windows that are simulated freely from the recorded state: how far a model is off after a while.

Stands beside the mismatch in the result; the same replay that `servoctl replay` runs. Every row is judged by a model
that was fitted without it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from servod.formats.model.axis_model import AxisModel
from servod.lab.diagnose.predict.predict import Predictor
from servod.lab.diagnose.result import FreeRun, HeldOutRecording, HeldOutWindow, Windows
from servod.lab.diagnose.select.free_windows import fold_errors
from servod.lab.diagnose.select.selection import Fold
from servod.lab.diagnose.settings import SETTINGS
from servod.lab.recordings import Recording
from servod.lab.simulate.replay import Drive, replay, switched_on

Array = NDArray[np.float64]


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


def window_errors(
    predictor: Predictor, nominal: AxisModel, base: Sequence[Fold], after: Sequence[Fold]
) -> list[WindowErrors]:
    """Errors for every horizon; each fold's model judges the rows that it has not seen."""
    whole = [Fold(np.ones(len(predictor.counts), dtype=bool), (nominal,))]
    return [
        WindowErrors(horizon, *(fold_errors(predictor, folds, horizon) for folds in (whole, base, after)))
        for horizon in SETTINGS.validation.horizons_s
    ]


def windows(errors: Sequence[WindowErrors], predictor: Predictor, judged: NDArray[np.bool_]) -> tuple[Windows, ...]:
    """Errors by length of the windows over the rows that are judged, and row by row where the model strays most."""
    longest = errors[-1].nominal
    worst = max(range(len(predictor.slices)), key=lambda i: float(np.mean(longest[predictor.slices[i]] ** 2)))
    trace, part = predictor.traces[worst], predictor.slices[worst]
    t_s = trace.drive.t_s - trace.shift_s
    return tuple(
        Windows(
            window.horizon_s, _free_run(window, judged), _each(window, predictor, judged), trace.name, t_s,
            window.nominal[part], window.after[part],
        )
        for window in errors
    )  # fmt: skip


def _each(window: WindowErrors, predictor: Predictor, judged: NDArray[np.bool_]) -> dict[str, FreeRun]:
    """Errors of each recording that has rows to judge by."""
    found = {}
    for trace, part in zip(predictor.traces, predictor.slices, strict=True):
        if judged[part].any():
            inside = np.zeros_like(judged)
            inside[part] = judged[part]
            found[trace.name] = _free_run(window, inside)
    return found


def _free_run(window: WindowErrors, judged: NDArray[np.bool_]) -> FreeRun:
    """Root mean squares over the rows that are judged."""
    errors = (window.nominal, window.recalibrated, window.after)
    return FreeRun(*(float(np.sqrt(np.mean(error[judged] ** 2))) for error in errors))


# --- Held-out recordings ---------------------------------------------------------------------------------------------
# Recordings that a diagnosis has not seen: how far the models are off there, in windows that are simulated freely.
#
# The engine's last stage. Nothing is fitted to these recordings, nor chosen by them.


def judge_held_out(
    nominal: AxisModel, extended: AxisModel, recordings: Sequence[Recording]
) -> tuple[HeldOutRecording, ...]:
    """Errors of both models, and of going on at the speed that the recording had, in each recording."""
    return tuple(
        HeldOutRecording(
            one.path.name, tuple(_window(nominal, extended, one, h) for h in SETTINGS.validation.horizons_s)
        )
        for one in recordings
    )


def _window(nominal: AxisModel, extended: AxisModel, recording: Recording, horizon_s: float) -> HeldOutWindow:
    drive, rows = switched_on(nominal, recording.driven_by(nominal)), recording.measured
    begun = replay(nominal, drive, horizon_s)
    after = begun if extended is nominal else replay(extended, drive, horizon_s)
    errors = (begun.error, after.error, coasting(drive, begun.starts))
    return HeldOutWindow(horizon_s, *(float(np.sqrt(np.mean(error[rows] ** 2))) for error in errors))


def coasting(drive: Drive, starts: NDArray[np.int64]) -> Array:
    """Position error of an axis that goes on from each of the rows `starts` at the recorded speed, rad or m."""
    last = starts[np.searchsorted(starts, np.arange(len(drive.t_s)), side="right") - 1]
    gone = drive.t_s - drive.t_s[last]
    return np.asarray(drive.position[last] + drive.motion[last, 1] * gone - drive.position)
