"""Errors on rows that a fit has not seen: some are left out in turn, and the rest is fitted again.

Stands between the chosen fit and the report. What is left out is a recording; a stretch of every recording instead
where there is only one, or where recordings have levels of their own, which no other recording foretells. Nothing
foretells an event in one recording either: its rows are not judged.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servod.formats.model.axis_model import AxisModel
from servod.lab.diagnose.effects.disturbance import EVERY
from servod.lab.diagnose.effects.hypothesis import Hypothesis
from servod.lab.diagnose.predict.predict import Predictor
from servod.lab.diagnose.select.fit import Fit, Fitter, Weighing, scale_of

Array = NDArray[np.float64]
Rows = NDArray[np.bool_]

#: Steps of each new fit; it starts from the one that has seen everything.
STEPS = 3

#: Stretches of each recording.
STRETCHES = 4

#: Rows so long behind an event are not judged either, s: a window that simulates freely carries it that far.
TAIL_S = 1.0

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
    parts = [_edges(part, 1 if whole else STRETCHES) for part in predictor.slices]
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
            found |= (t_s >= window["start_s"]) & (t_s <= window["end_s"] + TAIL_S)
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
    return fit if begun is None else fitter.refine(begun, STEPS, len(fit.coordinates))
