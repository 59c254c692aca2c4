"""Cross-validation: some rows are left out in turn, the rest is fitted again, and the rows left out are predicted.

The last stage of the selection. What is left out is a recording; a stretch of it instead where there is only one.
Nothing predicts an event in one recording: its rows are not judged.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servod.lab.diagnose.effects.disturbance import EVERY, NAME
from servod.lab.diagnose.effects.hypothesis import Hypothesis
from servod.lab.diagnose.predict.predict import Predictor
from servod.lab.diagnose.select.fit import Fit, Fitter, Weighing, scale_of
from servod.lab.diagnose.select.levels import named_terms
from servod.lab.diagnose.select.selection import CrossValidation, Fold, Folds, HeldOutErrors, Selection
from servod.lab.diagnose.select.selector import Selector
from servod.lab.diagnose.settings import SETTINGS

Array = NDArray[np.float64]
Rows = NDArray[np.bool_]

#: What is left out, as the report says it.
RECORDING, STRETCH = "one recording after the other", "one quarter of every recording after the other"


def cross_validate(selector: Selector, selection: Selection) -> Selection:
    """The selection with its errors on unseen rows; terms without which these are predicted better go, worst first."""
    validation = _validated(selector, selection)
    while (worst := _worst(selection, validation)) is not None:
        selection = selection.without_term(worst, validation.reduced[worst])
        validation = _validated(selector, selection)
    return replace(selection, validation=validation)


def _validated(selector: Selector, selection: Selection) -> CrossValidation:
    """Errors on unseen rows before and after, and without each term at the level of its effect."""
    predictor, fit, base = selector.predictor, selection.fit, selection.base
    named = named_terms(fit, selector.start.document)
    selector.on_progress("held-out recordings")
    reduced = {index: selector.settle_without(fit, index) for index in named}
    folds = make_folds(predictor, fit)
    before = predict_held_out(predictor, base, folds)
    after = predict_held_out(predictor, fit, folds) if fit is not base else before
    alone = len(named) == 1 and selection.terms == 1
    without = {index: before if alone else predict_held_out(predictor, one, folds) for index, one in reduced.items()}
    return CrossValidation(named, reduced, folds, before, after, without)


def _worst(selection: Selection, validation: CrossValidation) -> int | None:
    """The term without which unseen rows are predicted best, if better than with it; no event in one recording.

    Better over all and in most of the parts: a recording without which the others cannot tell back-EMF from friction
    is predicted badly whatever is in, and says nothing of a term that predicts the others.
    """
    events = single_events(selection.fit.hypothesis)
    others = {
        index: held.rms
        for index, held in validation.without.items()
        if held.rms <= validation.after.rms
        and index not in events
        and predicts_most(held, validation.after, validation.folds)
    }
    return min(others, key=lambda index: others[index]) if others else None


def predicts_most(one: HeldOutErrors, other: HeldOutErrors, folds: Folds) -> bool:
    """Whether `one` predicts most of the parts that were left out, as far as they are judged, better than `other`."""
    rows = [part & folds.judged for part in folds.parts]
    better = [bool(np.sum(one.mismatch[some] ** 2) <= np.sum(other.mismatch[some] ** 2)) for some in rows]
    return 2 * sum(better) > len(better)


def make_folds(predictor: Predictor, fit: Fit) -> Folds:
    """How the rows are shared out so that nothing of `fit` is judged by rows that it was fitted to."""
    whole = len(predictor.slices) > 1
    parts = [_edges(part, 1 if whole else SETTINGS.validation.stretches) for part in predictor.slices]
    groups = [[part[0]] for part in parts] if whole else [list(group) for group in zip(*parts, strict=True)]
    judged = predictor.counts & ~_events(predictor, fit)
    return Folds(
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
    for index in single_events(fit.hypothesis):
        document: dict[str, Any] = {}
        fit.hypothesis.terms[index].write(document, fit.values[fit.hypothesis.share(index)])
        for window in document[NAME]["windows"]:
            found |= (t_s >= window["start_s"]) & (t_s <= window["end_s"] + SETTINGS.validation.tail_s)
    return found


def single_events(hypothesis: Hypothesis) -> list[int]:
    """Places of the terms that are events in one recording: no other recording predicts them."""
    return [
        index
        for index, term in enumerate(hypothesis.terms)
        if term.effect == NAME and term.form != EVERY
    ]  # fmt: skip


def predict_held_out(predictor: Predictor, fit: Fit, folds: Folds) -> HeldOutErrors:
    """Mismatch of each fold under `fit` estimated again without it; events in one recording keep their values."""
    mismatch = np.zeros_like(fit.mismatch)
    models: list[Fold] = []
    coordinates: list[Array] = []
    for out in folds.parts:
        again = _refit(predictor, fit, predictor.counts & ~out)
        mismatch[out] = again.mismatch[out]
        models.append(Fold(out, tuple(again.hypothesis.models(again.coordinates, len(predictor.slices)))))
        coordinates.append(again.coordinates)
    rms = float(np.sqrt(np.mean(mismatch[folds.judged] ** 2)))
    return HeldOutErrors(mismatch, rms, tuple(models), tuple(coordinates))


def _refit(predictor: Predictor, fit: Fit, seen: Rows) -> Fit:
    """The fit estimated again on the rows that are seen, along its own Jacobian."""
    if seen.sum() < len(fit.coordinates):
        return fit
    jacobian = fit.jacobian.copy(order="K")
    for index in single_events(fit.hypothesis):
        jacobian[:, fit.hypothesis.share(index)] = 0.0
    scale = scale_of(fit.mismatch, seen, 1e-3 * predictor.dry)
    fitter = Fitter(predictor, Weighing(scale, seen.astype(np.float64)))
    begun = fitter.begin(fit.hypothesis, fit.coordinates, jacobian)
    return fit if begun is None else fitter.refine(begun, SETTINGS.validation.steps, len(fit.coordinates))
