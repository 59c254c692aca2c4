"""Where no name may stand: what is told as part of the answer, and which model is handed out."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from servod.formats.model.axis_model import AxisModel
from servod.lab.diagnose.judge.judgement import JudgedSelection, errors_of_names, without_names
from servod.lab.diagnose.judge.partial import best_model, model_without_names, partial_answer
from servod.lab.diagnose.judge.verdict import verdict
from servod.lab.diagnose.result import DiagnosisVerdict, FreeRun, MinorReason, Windows
from servod.lab.diagnose.select.candidates import Candidate
from servod.lab.diagnose.select.merit import Merit
from servod.lab.diagnose.select.selector import Selector
from servod.lab.diagnose.select.stepwise import _is_significant, forward_selection
from servod.lab.diagnose.settings import SETTINGS
from tests.lab.diagnose.axes import believed
from tests.lab.diagnose.test_findings import form, selecting, sorted_with


@pytest.fixture(scope="module")
def selector() -> Selector:
    """An axis with a weight, and with a push over position that is on nobody's list."""
    bump = {"grid": [-0.5, -0.1, 0.2, 0.5], "torque": [0.0, 0.02, -0.02, 0.0]}
    return selecting(believed(gravity={"amplitude": 0.1, "phase": 0.5}, residual={"position": bump}))


@pytest.fixture(scope="module")
def nameless(selector: Selector) -> JudgedSelection:
    return without_names(sorted_with(selector, form(selector, "gravity")))


def test_what_known_physics_takes_is_told_as_part_of_the_answer(nameless: JudgedSelection) -> None:
    part = partial_answer(nameless)
    assert nameless.named == () and part is not None
    (weight,) = part.effects
    assert weight.effect == "gravity" and weight.share > 0.7
    assert weight.parameters["amplitude"].value == pytest.approx(0.1, rel=0.2)


def test_a_table_is_judged_by_rows_that_it_has_not_seen(nameless: JudgedSelection) -> None:
    assert nameless.residual is not None
    for one, other in zip(nameless.tables, nameless.tables[1:], strict=False):
        tables = [getattr(fold.of(0).residual, nameless.residual.coordinate) for fold in (one, other)]
        assert tables[0].torque != tables[1].torque


def test_the_model_is_the_one_that_predicts_unseen_rows_best(nameless: JudgedSelection) -> None:
    model, free = model_without_names(nameless, believed())
    assert model.gravity is not None and model.gravity.amplitude == pytest.approx(0.1, rel=0.2)
    assert all(window.errors.after < 0.5 * window.errors.before for window in free)


def window(after: float) -> Windows:
    run, rows = FreeRun(1.0, after, after), np.zeros(3)
    return Windows(0.25, run, {"run": run}, "run", rows, rows, rows)


@pytest.mark.parametrize(("errors", "best"), [((0.9, 0.5), 1), ((0.4, 0.5), 0), ((1.1, 1.2), None), ((1.1, 0.9), 1)])
def test_no_model_is_worse_than_the_one_given(errors: tuple[float, float], best: int | None) -> None:
    given, models = believed(), [believed(inertia=inertia) for inertia in (0.04, 0.05)]
    answers: list[tuple[AxisModel, tuple[Windows, ...]]] = [
        (model, (window(error),)) for model, error in zip(models, errors, strict=True)
    ]
    assert best_model(given, answers)[0] is (given if best is None else models[best])


def test_a_candidate_at_the_end_of_its_range_sets_no_bar(selector: Selector, monkeypatch: pytest.MonkeyPatch) -> None:
    """It took nearly all, and could not come in; what took less did not get its turn."""
    begun = selector.fit_base()
    sine, cosine = form(selector, "gravity").unknowns
    narrow = replace(form(selector, "gravity"), unknowns=(replace(sine, low=-0.08, high=0.08), cosine))
    found = []
    for name, term, left in (("spring", narrow, 0.05), ("gravity", form(selector, "gravity"), 0.5)):
        hypothesis = begun.fit.hypothesis.with_term(term)
        fit = selector.settle(hypothesis, hypothesis.beside(begun.fit.coordinates), begun.fit.mismatch)
        found.append(Candidate(name, fit, left))
    rounds = iter([(found, 2)])
    monkeypatch.setattr(selector, "candidates", lambda *_some, **_more: next(rounds, ([], 0)))
    selection = forward_selection(selector, begun)
    assert [term.unknowns[0].low for term in selection.fit.hypothesis.terms[:1]] == [sine.low]


@pytest.mark.parametrize(("taken", "told"), [(0.5, True), (0.3, False)])
def test_a_drift_that_takes_much_of_the_means_needs_less(selector: Selector, taken: float, told: bool) -> None:
    gain = SETTINGS.drift.least_gain_of_most + 1.0 + math.log(float(selector.rows.sum()))
    assert _is_significant(selector, Merit(0.0, 0.0, 0.0, gain), taken) is told


@pytest.mark.parametrize(
    ("why", "found"),
    [(MinorReason.UNSURE, DiagnosisVerdict.UNEXPLAINED), (MinorReason.LEVEL, DiagnosisVerdict.MISSING_PHYSICS)],
)
def test_what_is_not_told_from_none_explains_nothing(
    selector: Selector, why: MinorReason, found: DiagnosisVerdict
) -> None:
    """A resonance on nobody's list was a gap for a quarter, which no interval told from none, and a saturation."""
    judged = sorted_with(selector, form(selector, "gravity"))
    merits = (replace(judged.selection.merits[0], share=0.25),)
    errors = replace(judged.errors, before=1.0, after=0.3, floor=0.01, removed=0.91)
    judged = replace(judged, selection=replace(judged.selection, merits=merits), errors=errors, kept={0: why})
    assert verdict((0,), errors_of_names(judged), 20.0) is found
