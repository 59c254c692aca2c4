"""A selection as it is judged: errors on everything and on unseen rows, covariance, maps of what is left.

Stands between cross-validation and the verdict; `findings` says which of its terms are findings, and `conclude` makes
the plain result of it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from servod.lab.diagnose.judge.covariance import total_covariance
from servod.lab.diagnose.judge.free_run import free_run_gain
from servod.lab.diagnose.judge.locate import maps
from servod.lab.diagnose.judge.residual_table import residual_table
from servod.lab.diagnose.judge.verdict import Shares, shares
from servod.lab.diagnose.predict.predict import Predictor
from servod.lab.diagnose.result import Map, MinorReason, ResidualTable
from servod.lab.diagnose.select.cross_validation import make_folds, predict_held_out, single_events
from servod.lab.diagnose.select.fit import Fit, Weighing
from servod.lab.diagnose.select.selection import CrossValidation, Selection
from servod.lab.diagnose.select.selector import Selector
from servod.lab.diagnose.settings import SETTINGS

Array = NDArray[np.float64]


@dataclass(frozen=True)
class JudgedSelection:
    """Everything that was judged of a selection, on recordings that can tell.

    `named` are places of terms in the fit; `errors` are those of the fits to everything, by which names are judged,
    `unseen` those on rows that the fits have not seen. `removed_by_known` is the share of the explainable error that
    known physics removes there, also where its names may not stand. `kept` says of terms in the fit why they are no
    findings.
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
    maps_before: list[Map]
    maps_after: list[Map]
    kept: Mapping[int, MinorReason] = field(default_factory=dict)

    @property
    def fit(self) -> Fit:
        """The fit that stands."""
        return self.selection.fit

    def removed_share(self, place: int) -> float:
        """The share of the explainable error on unseen rows that a named term removes."""
        unseen = self.unseen
        without = float(np.mean(self.validation.without[place].mismatch[self.predictor.counts] ** 2))
        return max(without - unseen.after**2, 0.0) / max(unseen.before**2 - unseen.floor**2, 1e-30)


def judge(selector: Selector, selection: Selection) -> JudgedSelection:
    """A selection that was cross-validated, judged; every term at the level of its effect has its name as yet."""
    predictor, fit, base, validation = selector.predictor, selection.fit, selection.base, selection.validation
    if validation is None:
        raise ValueError("a selection is judged when it was cross-validated")
    weighing = Weighing(selector.fitter(fit.mismatch).weighing.scale, selector.rows)
    seen, unseen = (
        shares(pair, predictor.counts, selection.floor)
        for pair in ((base.mismatch, fit.mismatch), (validation.before.mismatch, validation.after.mismatch))
    )
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


def predicts_nothing(judgement: JudgedSelection) -> bool:
    """Whether free windows are hardly better for the names, although something is left: terms that only fit.

    Names of events in one recording alone are not asked, since no other recording predicts them.
    """
    validation, unseen = judgement.validation, judgement.unseen
    within_noise = unseen.after < SETTINGS.validation.fitted_floors * unseen.floor
    if within_noise or set(judgement.named) <= set(single_events(judgement.fit.hypothesis)):
        return False
    gain = free_run_gain(judgement.predictor, validation.before, validation.after, validation.folds.judged)
    return gain > SETTINGS.validation.most_free_run_error


def without_names(judgement: JudgedSelection) -> JudgedSelection:
    """The judgement when no name may stand: the base, and a table of what is left without a name."""
    predictor, base, floor = judgement.predictor, judgement.selection.base, judgement.selection.floor
    left = residual_table(predictor, base.mismatch)
    size = len(base.coordinates)
    folds = make_folds(predictor, base)
    before = predict_held_out(predictor, base, folds)
    errors, unseen = (shares((rows, rows), predictor.counts, floor) for rows in (base.mismatch, before.mismatch))
    validation = CrossValidation((), {}, folds, before, before, {})
    bare = replace(judgement.selection, fit=base, merits=(), entries=(), validation=validation)
    return replace(
        judgement, selection=bare, validation=validation, named=(), kept={}, errors=errors, unseen=unseen,
        covariance=judgement.covariance[:size, :size], residual=left, maps_after=judgement.maps_before,
    )  # fmt: skip
