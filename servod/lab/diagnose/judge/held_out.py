"""Errors on rows that a fit has not seen: some are left out in turn, and the rest is fitted again.

Stands between the chosen fit and the report. What is left out is a recording; a stretch of every recording instead
where there is only one, or where recordings have levels of their own, which no other recording foretells. Nothing
foretells an event in one recording either: its rows are not judged.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servod.formats.model.axis_model import AxisModel
from servod.lab.diagnose.data.trace import Trace
from servod.lab.diagnose.effects.disturbance import EVERY
from servod.lab.diagnose.effects.hypothesis import Hypothesis
from servod.lab.diagnose.predict.predict import Predictor
from servod.lab.diagnose.result import FreeRun, Windows
from servod.lab.diagnose.select.fit import Fit, Fitter, Weighing, scale_of
from servod.lab.diagnose.settings import SETTINGS
from servod.lab.simulate.replay import Drive, replay

Array = NDArray[np.float64]
Rows = NDArray[np.bool_]

#: What is left out, as the report says it.
RECORDING, STRETCH = "one recording after the other", "one quarter of every recording after the other"


@dataclass(frozen=True)
class Split:
    """Rows that are left out together, what they are in words, and the rows by which fits are judged."""

    folds: tuple[Rows, ...]
    left_out: str
    judged: Rows


@dataclass(frozen=True)
class Fold:
    """Rows that were left out together, and what was fitted without them: a model for all recordings or for each."""

    rows: Rows
    models: tuple[AxisModel, ...]

    def of(self, recording: int) -> AxisModel:
        """The model of a recording."""
        return self.models[recording if len(self.models) > 1 else 0]


@dataclass(frozen=True)
class HeldOut:
    """Mismatch (N*m) of every row by a fit that has not seen it; `rms` is over the rows that are judged.

    `coordinates` are those of each fold's fit.
    """

    mismatch: Array
    rms: float
    folds: tuple[Fold, ...] = ()
    coordinates: tuple[Array, ...] = ()


def split(predictor: Predictor, fit: Fit) -> Split:
    """How the rows are shared out so that nothing of `fit` is judged by rows that it was fitted to."""
    own_levels = any(term.each is not None for term in fit.hypothesis.terms)
    whole = len(predictor.slices) > 1 and not own_levels
    parts = [_edges(part, 1 if whole else SETTINGS.validation.stretches) for part in predictor.slices]
    groups = [[part[0]] for part in parts] if whole else [list(group) for group in zip(*parts, strict=True)]
    judged = predictor.counts & ~_events(predictor, fit)
    return Split(
        tuple(_rows(predictor, group) for group in groups),
        RECORDING if whole else STRETCH,
        judged if judged.any() else predictor.counts,
    )


def _edges(part: slice, count: int) -> list[slice]:
    """A recording in `count` stretches."""
    edges = np.linspace(part.start, part.stop, count + 1).astype(int)
    return [slice(int(a), int(b)) for a, b in pairwise(edges)]


def _rows(predictor: Predictor, parts: list[slice]) -> Rows:
    found = np.zeros(len(predictor.counts), dtype=bool)
    for part in parts:
        found[part] = True
    return found


def _events(predictor: Predictor, fit: Fit) -> Rows:
    """Rows in and shortly behind the events that stand in one recording only."""
    t_s, found = predictor.over("t_s"), np.zeros(len(predictor.counts), dtype=bool)
    for place in once(fit.hypothesis):
        document: dict[str, Any] = {}
        fit.hypothesis.terms[place].write(document, fit.values[fit.hypothesis.share(place)])
        for window in document["disturbance"]["windows"]:
            found |= (t_s >= window["start_s"]) & (t_s <= window["end_s"] + SETTINGS.validation.tail_s)
    return found


def once(hypothesis: Hypothesis) -> list[int]:
    """Places of the terms that are events in one recording: nobody can foretell them."""
    return [
        place
        for place, term in enumerate(hypothesis.terms)
        if term.effect == "disturbance" and term.form != EVERY
    ]  # fmt: skip


def held_out(predictor: Predictor, fit: Fit, shared: Split) -> HeldOut:
    """Mismatch of each fold under `fit` estimated again without it; events in one recording keep their values."""
    mismatch = np.zeros_like(fit.mismatch)
    models: list[Fold] = []
    coordinates: list[Array] = []
    for out in shared.folds:
        again = _again(predictor, fit, predictor.counts & ~out)
        mismatch[out] = again.mismatch[out]
        models.append(Fold(out, tuple(again.hypothesis.models(again.coordinates, len(predictor.slices)))))
        coordinates.append(again.coordinates)
    rms = float(np.sqrt(np.mean(mismatch[shared.judged] ** 2)))
    return HeldOut(mismatch, rms, tuple(models), tuple(coordinates))


def _again(predictor: Predictor, fit: Fit, seen: Rows) -> Fit:
    """The fit estimated anew on the rows that are seen, along its own Jacobian."""
    if seen.sum() < len(fit.coordinates):
        return fit
    jacobian = fit.jacobian.copy()
    for place in once(fit.hypothesis):
        jacobian[:, fit.hypothesis.share(place)] = 0.0
    scale = scale_of(fit.mismatch, seen, 1e-3 * predictor.dry)
    fitter = Fitter(predictor, Weighing(scale, seen.astype(np.float64)))
    begun = fitter.begin(fit.hypothesis, fit.coordinates, jacobian)
    return fit if begun is None else fitter.refine(begun, SETTINGS.validation.steps, len(fit.coordinates))


# Errors of windows that are simulated freely from the recorded state: how far a model is off after a while.
#
# Stands beside the mismatch in the report; the same replay that `servoctl replay` runs. Every row is judged by a model
# that was fitted without it.


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
        WindowErrors(horizon, *(_errors(predictor, folds, horizon) for folds in (whole, base, after)))
        for horizon in SETTINGS.validation.horizons_s
    ]


def foretold(predictor: Predictor, before: HeldOut, after: HeldOut, judged: NDArray[np.bool_]) -> float:
    """RMS of the shortest windows by fits with the physics added, as a multiple of that by fits without it."""
    with_it, without = (
        _errors(predictor, held.folds, SETTINGS.validation.horizons_s[0])[judged] for held in (after, before)
    )
    return float(np.sqrt(np.mean(with_it**2) / max(float(np.mean(without**2)), 1e-30)))


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
