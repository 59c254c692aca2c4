"""Errors on recordings that a fit has not seen: each recording in turn is left out, the rest is fitted again.

Stands between the chosen fit and the report. A single recording is split into four stretches instead.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from servod.axis_model import AxisModel
from servod.diagnose.fit import Fit, Fitter, Weighing, scale_of
from servod.diagnose.predict import Predictor

Array = NDArray[np.float64]
Rows = NDArray[np.bool_]

#: Steps of each new fit; it starts from the one that has seen everything.
STEPS = 3

#: Stretches of a single recording.
STRETCHES = 4


@dataclass(frozen=True)
class Fold:
    """Rows that were left out together, and the model that was fitted without them."""

    rows: Rows
    model: AxisModel


@dataclass(frozen=True)
class HeldOut:
    """Mismatch (N*m) of every row by a fit that has not seen it; `rms` is over the rows that count.

    `coordinates` are those of each fold's fit.
    """

    mismatch: Array
    rms: float
    folds: tuple[Fold, ...] = ()
    coordinates: tuple[Array, ...] = ()


def folds(predictor: Predictor) -> list[Rows]:
    """Rows that are left out together."""
    rows = len(predictor.counts)
    parts = predictor.slices
    if len(parts) == 1:
        edges = np.linspace(0, rows, STRETCHES + 1).astype(int)
        parts = tuple(slice(int(a), int(b)) for a, b in pairwise(edges))
    found = []
    for part in parts:
        out = np.zeros(rows, dtype=bool)
        out[part] = True
        found.append(out)
    return found


def held_out(predictor: Predictor, fit: Fit, frozen: Rows) -> HeldOut:
    """Mismatch of each fold under `fit` estimated again without it; coordinates in `frozen` keep their values.

    Events that stand in one recording only are frozen: nobody can foretell them.
    """
    mismatch = np.zeros_like(fit.mismatch)
    least = 1e-3 * predictor.dry
    models: list[Fold] = []
    coordinates: list[Array] = []
    free = Fit(fit.hypothesis, fit.coordinates, fit.mismatch, fit.cost, np.where(frozen, 0.0, fit.jacobian), False)
    for out in folds(predictor):
        rows = (predictor.counts & ~out).astype(np.float64)
        weighing = Weighing(scale_of(fit.mismatch, predictor.counts, least), rows)
        fitter = Fitter(predictor, weighing)
        begun = fitter.begin(fit.hypothesis, fit.coordinates, free.jacobian)
        if begun is None or rows.sum() < len(fit.coordinates):
            again = fit
        else:
            again = fitter.refine(begun, STEPS, len(fit.coordinates))
        mismatch[out] = again.mismatch[out]
        models.append(Fold(out, again.model))
        coordinates.append(again.coordinates)
    return HeldOut(
        mismatch, float(np.sqrt(np.mean(mismatch[predictor.counts] ** 2))), tuple(models), tuple(coordinates)
    )
