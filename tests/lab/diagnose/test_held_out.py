"""Rows that a fit has not seen: no number of it may come from them, and what nothing predicts is not judged."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from servod.lab.diagnose.effects import effect
from servod.lab.diagnose.effects.disturbance import EVERY
from servod.lab.diagnose.effects.hypothesis import Term
from servod.lab.diagnose.effects.search_context import SearchContext
from servod.lab.diagnose.judge.free_run import window_errors
from servod.lab.diagnose.predict.predict import Predictor
from servod.lab.diagnose.select.candidates import Candidate, _alike
from servod.lab.diagnose.select.cross_validation import (
    RECORDING,
    make_folds,
    predict_held_out,
    predicts_most,
    single_events,
)
from servod.lab.diagnose.select.fit import Fit, Fitter, Weighing
from servod.lab.diagnose.select.free_windows import free_run_gain
from servod.lab.diagnose.select.selection import Fold, Folds, HeldOutErrors
from servod.lab.diagnose.settings import SETTINGS
from servod.lab.simulate.replay import replay
from tests.lab.diagnose.axes import believed
from tests.lab.diagnose.test_between import colder


@pytest.fixture(scope="module")
def levels() -> tuple[Predictor, Fit]:
    """Three recordings, the last with 1.3 times the friction of the first, and a fit in which it grows with them."""
    predictor, fit = colder(1.3)
    return predictor, with_jacobian(predictor, fit)


def with_jacobian(predictor: Predictor, fit: Fit) -> Fit:
    """The fit with the slopes at where it stands."""
    fitter = Fitter(predictor, Weighing(0.001, predictor.counts.astype(np.float64)))
    return replace(fit, jacobian=fitter.derivatives(fit))


def with_term(predictor: Predictor, fit: Fit, term: Term) -> Fit:
    """The base of a fit with another term in place of its own, at that term's start."""
    hypothesis = replace(fit.hypothesis, terms=(term,))
    mismatch = predictor.mismatch(*hypothesis.models(hypothesis.start, len(predictor.traces)))
    return with_jacobian(predictor, Fit(hypothesis, hypothesis.start, mismatch, 0.0, np.zeros((0, 0)), True))


def bare(fit: Fit) -> Fit:
    """The start of the base alone."""
    hypothesis = fit.hypothesis.without(0)
    jacobian = fit.jacobian[:, : len(hypothesis.base)]
    return replace(fit, hypothesis=hypothesis, coordinates=hypothesis.start, jacobian=jacobian)


def pushes(predictor: Predictor) -> list[Term]:
    """Windows in which a torque would act, were half a second of both recordings off."""
    trace, mismatch = predictor.traces[0], np.zeros(len(predictor.counts))
    for part in predictor.slices:
        first = part.start + round(2.0 / trace.period_s)
        mismatch[first : first + round(0.5 / trace.period_s)] = 0.05
    return effect("disturbance").terms(SearchContext({}, predictor, mismatch))


@pytest.mark.parametrize(
    ("single", "every", "alike"), [(0.012, 0.017, True), (0.40, 0.44, True), (0.01, 0.05, False), (0.40, 0.60, False)]
)
def test_a_push_in_one_recording_and_in_all_are_alike_where_the_others_were_cut(
    levels: tuple[Predictor, Fit], single: float, every: float, alike: bool
) -> None:
    """Both are fitted on everything then: the one in all of them explains next to nothing there."""
    predictor, fit = levels
    terms = {term.form: with_term(predictor, bare(fit), term) for term in pushes(predictor)}
    left = {form: every if form == EVERY else single for form in terms}
    one, other = (Candidate("disturbance", terms[form], left[form]) for form in terms)
    assert _alike(one, other) is alike


def test_a_level_is_not_that_of_the_rows_that_it_is_judged_by(levels: tuple[Predictor, Fit]) -> None:
    """Wherever it stood before: the levels of a recording left out are those that the others predict."""
    predictor, fit = levels
    elsewhere = fit.coordinates.copy()
    elsewhere[fit.hypothesis.share(0)] += [0.0, 0.0, 0.1, 0.1]
    mismatch = predictor.mismatch(*fit.hypothesis.models(elsewhere, 3))
    moved = with_jacobian(predictor, replace(fit, coordinates=elsewhere, mismatch=mismatch))
    shared = make_folds(predictor, fit)
    near, far = (predict_held_out(predictor, one, shared) for one in (fit, moved))
    assert shared.left_out == RECORDING
    assert float(np.sqrt(np.mean(mismatch[predictor.counts] ** 2))) > 3.0 * near.rms
    assert far.rms == pytest.approx(near.rms, rel=0.15)
    for one, other in zip(near.coordinates, far.coordinates, strict=True):
        assert other[fit.hypothesis.share(0)] == pytest.approx(one[fit.hypothesis.share(0)], abs=0.03)


def test_every_row_is_left_out_single_events(levels: tuple[Predictor, Fit]) -> None:
    predictor, fit = levels
    for shared in (make_folds(predictor, fit), make_folds(predictor, bare(fit))):
        assert np.all(np.sum(shared.parts, axis=0) == 1)
    assert shared.left_out == RECORDING
    assert len(shared.parts) == 3


def test_models_of_a_fold_have_the_levels_of_their_recordings(levels: tuple[Predictor, Fit]) -> None:
    predictor, fit = levels
    held = predict_held_out(predictor, fit, make_folds(predictor, fit))
    for fold in held.folds:
        ratio = fold.of(2).friction.viscous / fold.of(0).friction.viscous
        assert ratio == pytest.approx(1.3, rel=0.03)


def test_windows_are_judged_by_the_model_that_has_not_seen_them(levels: tuple[Predictor, Fit]) -> None:
    predictor, fit = levels
    models = [believed(inertia=0.02 * factor) for factor in (0.9, 1.2, 1.1)]
    folds = [Fold(rows, (model,)) for rows, model in zip(make_folds(predictor, bare(fit)).parts, models, strict=True)]
    window = window_errors(predictor, believed(), folds, folds)[0]
    for part, trace, model in zip(predictor.slices, predictor.traces, models, strict=True):
        drive = replace(trace.drive, t_s=trace.drive.t_s - trace.shift_s)
        for error, judge in ((window.recalibrated, model), (window.nominal, believed())):
            assert np.allclose(error[part], replay(judge, drive, window.horizon_s).error, atol=1e-12)


def test_no_number_of_a_fold_comes_from_the_rows_left_out(levels: tuple[Predictor, Fit]) -> None:
    """With another command in the first recording: what was fitted without it is the same to the last bit."""
    predictor, fit = levels
    drive = predictor.traces[0].drive
    spoiled = replace(predictor.traces[0], drive=replace(drive, torque=1.2 * drive.torque))
    other = Predictor((spoiled, *predictor.traces[1:]), believed(), predictor.rate)
    found = []
    for one in (predictor, other):
        start = replace(bare(fit), mismatch=one.mismatch(believed()))
        found.append(predict_held_out(one, start, make_folds(one, start)))
    assert np.array_equal(found[0].coordinates[0], found[1].coordinates[0])
    assert not np.allclose(found[0].coordinates[1], found[1].coordinates[1], atol=1e-3)
    assert not np.allclose(found[0].mismatch, found[1].mismatch, atol=1e-3)


def test_an_event_in_one_recording_is_not_judged(levels: tuple[Predictor, Fit]) -> None:
    predictor, fit = levels
    term = next(term for term in pushes(predictor) if term.form != EVERY)
    event = with_term(predictor, fit, term)
    shared, t_s = make_folds(predictor, event), predictor.over("t_s")
    document: dict[str, Any] = {}
    term.write(document, event.values[event.hypothesis.share(0)])
    (window,) = document["disturbance"]["windows"]
    inside = (t_s >= window["start_s"]) & (t_s <= window["end_s"] + SETTINGS.validation.tail_s)
    assert single_events(event.hypothesis) == [0]
    assert not shared.judged[inside].any()
    assert np.array_equal(shared.judged[~inside], predictor.counts[~inside])
    held = predict_held_out(predictor, event, shared)
    assert held.rms == pytest.approx(float(np.sqrt(np.mean(held.mismatch[shared.judged] ** 2))))
    for coordinates in held.coordinates:
        assert np.array_equal(coordinates[event.hypothesis.share(0)], event.coordinates[event.hypothesis.share(0)])


def test_an_event_of_every_recording_is_predicted_by_the_others(levels: tuple[Predictor, Fit]) -> None:
    """A torque that is not there goes by the first recording, which is exactly the model's."""
    three, fit = levels
    predictor = Predictor(three.traces[:2], believed(), three.rate)
    event = with_term(predictor, fit, next(term for term in pushes(predictor) if term.form == EVERY))
    shared = make_folds(predictor, event)
    held = predict_held_out(predictor, event, shared)
    assert np.array_equal(shared.judged, predictor.counts)
    torque = event.hypothesis.share(0).stop - 1
    assert abs(event.coordinates[torque]) > 0.2
    assert abs(held.coordinates[1][torque]) < 0.01


def test_free_windows_of_unseen_rows_come_nearer_with_the_terms(levels: tuple[Predictor, Fit]) -> None:
    predictor, fit = levels
    shared = make_folds(predictor, fit)
    without, with_it = predict_held_out(predictor, bare(fit), shared), predict_held_out(predictor, fit, shared)
    assert free_run_gain(predictor, without, without, shared.judged) == pytest.approx(1.0)
    assert free_run_gain(predictor, without, with_it, shared.judged) < 0.3
    assert free_run_gain(predictor, with_it, without, shared.judged) > 3.0


@pytest.mark.parametrize(("off", "most"), [([0.1, 0.3, 0.3], False), ([0.1, 0.1, 0.9], True), ([0.1, 0.3], False)])
def test_one_part_that_is_predicted_badly_does_not_speak_for_the_others(off: list[float], most: bool) -> None:
    """Errors of 0.2 are what it is compared to; the last row of each part is not judged."""
    number = np.repeat(np.arange(len(off)), 4)
    judged = np.tile([True, True, True, False], len(off))
    folds = Folds(tuple(number == part for part in range(len(off))), RECORDING, judged)
    one = HeldOutErrors(np.where(judged, np.array(off)[number], 50.0), 0.0)
    assert predicts_most(one, HeldOutErrors(np.full(len(number), 0.2), 0.0), folds) is most
