"""A selection as it is judged: errors on everything and on unseen rows, covariance, maps of what is left.

Stands between cross-validation and the verdict; `findings` says which of its terms are findings, and `conclude` makes
the plain result of it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from servod.formats.model.axis_model import AxisModel
from servod.lab.diagnose.effects.base import document_of
from servod.lab.diagnose.effects.hypothesis import Document
from servod.lab.diagnose.judge.covariance import total_covariance
from servod.lab.diagnose.judge.locate import maps
from servod.lab.diagnose.judge.verdict import Shares, shares, without_event
from servod.lab.diagnose.predict.floor import above_noise
from servod.lab.diagnose.predict.predict import Predictor
from servod.lab.diagnose.result import MinorReason, MismatchMap, ResidualTable
from servod.lab.diagnose.select.cross_validation import make_folds, predict_held_out, single_events
from servod.lab.diagnose.select.fit import Fit, Weighing
from servod.lab.diagnose.select.free_windows import free_run_gain
from servod.lab.diagnose.select.selection import CrossValidation, Fold, Folds, HeldOutErrors, Selection
from servod.lab.diagnose.select.selector import Selector
from servod.lab.diagnose.settings import SETTINGS

Array = NDArray[np.float64]
Rows = NDArray[np.bool_]

# --- What fits no known physics --------------------------------------------------------------------------------------
# What fits no known physics: kept as a table over the coordinate where it lives, without a name. The table becomes
# `residual` in the axis model file.


def residual_table(predictor: Predictor, mismatch: Array) -> ResidualTable | None:
    """The table that predicts most of the mismatch of unseen stretches; None where none predicts enough."""
    found = [_table(name, values, predictor, mismatch) for name, values in _table_coordinates(predictor).items()]
    best = max(found, key=lambda table: table.share)
    return best if best.share >= SETTINGS.maps.table_least_share else None


def _table_coordinates(predictor: Predictor) -> dict[str, Array]:
    """Coordinates of tables, as late as the observer shows a torque there."""
    late = 2.0 * SETTINGS.observer.poles_damping / predictor.rate
    velocity = predictor.over("velocity")
    return {
        "position": predictor.over("position") - late * velocity,
        "velocity": velocity - late * predictor.over("acceleration"),
    }


def _table(name: str, values: Array, predictor: Predictor, mismatch: Array, seen: Rows | None = None) -> ResidualTable:
    """Least squares of a piecewise linear function, and its share on every second stretch from the others.

    Of the rows that are `seen`; of all that count where nobody says.
    """
    rows = np.flatnonzero(predictor.counts if seen is None else predictor.counts & seen)
    grid = np.unique(np.quantile(values[rows], np.linspace(0.002, 0.998, SETTINGS.maps.table_points)))
    design = hats(values[rows], grid)
    stretch = (rows // max(1, round(1.0 / predictor.traces[0].period_s))) % 2 == 0
    share = 0.0
    for part in (stretch, ~stretch):
        predicted = design[~part] @ _ridge(design[part], mismatch[rows][part])
        left = mismatch[rows][~part] - predicted
        share += 0.5 * (1.0 - float(left @ left) / max(float(np.sum(mismatch[rows][~part] ** 2)), 1e-30))
    return ResidualTable(name, grid, -_ridge(design, mismatch[rows]), share)


def _ridge(design: Array, wanted: Array) -> Array:
    normal = design.T @ design
    return np.asarray(np.linalg.solve(normal + 1e-6 * np.trace(normal) * np.eye(len(normal)), design.T @ wanted))


def write_table(document: Document, table: ResidualTable) -> None:
    """Add the table to a model's document."""
    rows = {"grid": table.grid.tolist(), "torque": table.torque.tolist()}
    document.setdefault("residual", {})[table.coordinate] = rows


def _with_tables(predictor: Predictor, folds: Folds, held: HeldOutErrors, coordinate: str) -> tuple[Fold, ...]:
    """The models of every fold with a table over `coordinate` that has not seen the fold's rows either."""
    found = []
    for out, fold in zip(folds.parts, held.folds, strict=True):
        table = _table(
            coordinate, _table_coordinates(predictor)[coordinate], predictor, predictor.mismatch(*fold.models), ~out
        )
        documents = [document_of(model) for model in fold.models]
        for document in documents:
            write_table(document, table)
        found.append(Fold(out, tuple(AxisModel.model_validate(document) for document in documents)))
    return tuple(found)


def hats(values: Array, grid: Array) -> Array:
    """Piecewise linear basis on `grid`, zero outside."""
    node = np.clip(np.searchsorted(grid, values, side="right") - 1, 0, len(grid) - 2)
    share = (values - grid[node]) / (grid[node + 1] - grid[node])
    inside = (values >= grid[0]) & (values <= grid[-1])
    design = np.zeros((len(values), len(grid)))
    row = np.arange(len(values))
    design[row, node] = np.where(inside, 1.0 - share, 0.0)
    design[row, node + 1] = np.where(inside, share, 0.0)
    return design


@dataclass(frozen=True)
class JudgedSelection:
    """Everything that was judged of a selection, on recordings that can tell.

    `named` are places of terms in the fit; `errors` are those of the fits to everything, by which names are judged
    (less what happened once), `unseen` those on rows that the fits have not seen. `removed_by_known` is the share of
    the explainable error that known physics removes there, also where its names may not stand. `kept` says of terms in
    the fit why they are no findings. Where no name may stand, `tables` are the models of every fold with a table of
    what is left, and `partial` is the judgement whose names are a part of the answer.
    """

    predictor: Predictor
    selection: Selection
    validation: CrossValidation
    named: tuple[int, ...]
    errors: Shares
    unseen: Shares
    removed_by_known: float
    covariance: Array
    residual: ResidualTable | None
    maps_before: list[MismatchMap]
    maps_after: list[MismatchMap]
    kept: Mapping[int, MinorReason] = field(default_factory=dict)
    tables: tuple[Fold, ...] = ()
    partial: JudgedSelection | None = None

    @property
    def fit(self) -> Fit:
        """The fit that stands."""
        return self.selection.fit

    def removed_share(self, index: int) -> float:
        """The share of the explainable error on unseen rows that a named term removes."""
        unseen = self.unseen
        without = float(np.mean(self.validation.without[index].mismatch[self.predictor.counts] ** 2))
        return max(without - unseen.after**2, 0.0) / above_noise(unseen.before**2, unseen.floor**2)


def judge(selector: Selector, selection: Selection) -> JudgedSelection:
    """A selection that was cross-validated, judged; every term at the level of its effect has its name as yet."""
    predictor, fit, base, validation = selector.predictor, selection.fit, selection.base, selection.validation
    if validation is None:
        raise ValueError("a selection is judged when it was cross-validated")
    weighing = Weighing(selector.fitter(fit.mismatch).weighing.scale, selector.rows)
    held = validation.before.mismatch, validation.after.mismatch
    seen = shares((base.mismatch, fit.mismatch), without_event(predictor, fit.mismatch), selection.floor)
    unseen = shares(held, predictor.counts, selection.floor)
    return JudgedSelection(
        predictor=predictor,
        selection=selection,
        validation=validation,
        named=validation.named,
        errors=seen,
        unseen=unseen,
        removed_by_known=unseen.removed,
        covariance=total_covariance(fit, weighing, predictor.traces[0].period_s, validation.after),
        residual=None,
        maps_before=maps(predictor, base.mismatch),
        maps_after=maps(predictor, fit.mismatch),
    )


def errors_of_names(judgement: JudgedSelection) -> Shares:
    """The errors where what is taken by terms that are not told from none counts as left: they explain nothing."""
    merits, errors = judgement.selection.merits, judgement.errors
    unsure = [index for index, why in judgement.kept.items() if why is MinorReason.UNSURE]
    share = sum(max(merits[index].share, 0.0) for index in unsure)
    after = errors.after**2 + share * above_noise(errors.before**2, errors.floor**2)
    return replace(errors, after=math.sqrt(after), removed=max(errors.removed - share, 0.0))


def predicts_nothing(judgement: JudgedSelection) -> bool:
    """Whether free windows are hardly better for the names, although something is left: terms that only fit.

    Names of events in one recording alone are not asked, since no other recording predicts them.
    """
    validation, unseen = judgement.validation, judgement.unseen
    within_noise = unseen.after < SETTINGS.validation.fitted_floors * unseen.floor
    predicted = unseen.after < SETTINGS.validation.predicted_share * unseen.before
    if within_noise or predicted or set(judgement.named) <= set(single_events(judgement.fit.hypothesis)):
        return False
    gain = free_run_gain(judgement.predictor, validation.before, validation.after, validation.folds.judged)
    driven = any(trace.drive.told is not None for trace in judgement.predictor.traces)
    most = SETTINGS.validation.most_free_run_error_by_drive if driven else SETTINGS.validation.most_free_run_error
    return gain > most


def without_names(judgement: JudgedSelection) -> JudgedSelection:
    """The judgement when no name may stand: the base, and a table of what is left without a name."""
    predictor, base, floor = judgement.predictor, judgement.selection.base, judgement.selection.floor
    left = residual_table(predictor, base.mismatch)
    size = len(base.coordinates)
    folds = make_folds(predictor, base)
    before = predict_held_out(predictor, base, folds)
    errors, unseen = (shares((rows, rows), predictor.counts, floor) for rows in (base.mismatch, before.mismatch))
    validation = CrossValidation((), {}, folds, before, before, {})
    tables = _with_tables(predictor, folds, before, left.coordinate) if left is not None else ()
    partial = judgement if judgement.named and not predicts_nothing(judgement) else None
    bare = replace(judgement.selection, fit=base, merits=(), entries=(), validation=validation)
    return replace(
        judgement, selection=bare, validation=validation, named=(), kept={}, errors=errors, unseen=unseen,
        covariance=judgement.covariance[:size, :size], residual=left, maps_after=judgement.maps_before,
        tables=tables, partial=partial,
    )  # fmt: skip
