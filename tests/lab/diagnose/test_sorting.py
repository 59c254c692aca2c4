"""Terms that stay in the model and are no findings: too small, under their level, at an end, not told from none."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from servod.formats.model.axis_model import AxisModel
from servod.lab.diagnose.data.intake import taken_in
from servod.lab.diagnose.effects import effect
from servod.lab.diagnose.effects.hypothesis import Term
from servod.lab.diagnose.effects.scene import Scene
from servod.lab.diagnose.engine import proved
from servod.lab.diagnose.judge.conclude import minor
from servod.lab.diagnose.judge.judgement import Judgement
from servod.lab.diagnose.judge.sorting import sorted_out, told_from_none
from servod.lab.diagnose.predict.predict import Predictor
from servod.lab.diagnose.result import Kept
from servod.lab.diagnose.select.choice import Choice, Entry
from servod.lab.diagnose.select.choose import Chooser
from servod.lab.diagnose.select.fit import Fit
from servod.lab.diagnose.select.merit import Merit, of_size
from tests.lab.diagnose.axes import believed, record

#: What a term is said to be worth before anybody has looked.
UNKNOWN = Merit(math.nan, math.nan, math.nan, math.nan)


def choosers(hidden: AxisModel) -> Chooser:
    """The choice on an axis that conceals something."""
    predictor = Predictor(taken_in(record(hidden, seconds=2.0)[:2], believed())[0], believed())
    chooser = Chooser(predictor, believed(), math.inf, lambda _line: None)
    chooser.base_error = chooser.error(predictor.mismatch(believed()))
    return chooser


@pytest.fixture(scope="module")
def chooser() -> Chooser:
    """An axis with a weight."""
    return choosers(believed(gravity={"amplitude": 0.1, "phase": 0.5}))


def form(chooser: Chooser, name: str) -> Term:
    """The first form of an effect."""
    mismatch = chooser.predictor.mismatch(believed())
    return effect(name).terms(Scene(chooser.start.document, chooser.predictor, mismatch))[0]


def sorted_with(chooser: Chooser, *terms: Term) -> Judgement:
    """The judgement of these terms, fitted together."""
    base = chooser.settled(chooser.start, None, chooser.predictor.mismatch(believed()))
    fit = base
    for term in terms:
        hypothesis = fit.hypothesis.with_term(term)
        fit = chooser.settled(hypothesis, hypothesis.beside(fit.coordinates), fit.mismatch)
    choice = Choice(base, fit, [UNKNOWN for _ in terms], [Entry(0.1, []) for _ in terms], {"gravity": UNKNOWN}, 0.0, 1)
    return sorted_out(proved(chooser.predictor, chooser, choice, lambda _line: None), chooser)


def test_what_is_small_or_under_its_level_stays_in_the_model_and_is_told(chooser: Chooser) -> None:
    terms = [form(chooser, name) for name in ("gravity", "torque_gain", "viscous_nonlinear")]
    judgement = sorted_with(chooser, *terms)
    assert judgement.named == [0]
    assert judgement.kept == {1: Kept.LEVEL, 2: Kept.SMALL}
    told = minor(judgement)
    assert list(told) == ["viscous_nonlinear", "torque_gain"]
    parameters = told["torque_gain"].parameters
    assert parameters is not None
    assert parameters["factor"].low < parameters["factor"].value < parameters["factor"].high
    assert judgement.choice.merits[0].share > 0.7


def test_what_ends_at_the_end_of_a_range_is_no_finding(chooser: Chooser) -> None:
    sine, cosine = form(chooser, "gravity").unknowns
    narrow = replace(form(chooser, "gravity"), unknowns=(replace(sine, low=-0.03, high=0.03), cosine))
    judgement = sorted_with(chooser, narrow)
    assert judgement.named == []
    assert judgement.kept == {0: Kept.AT_END}
    assert minor(judgement)["gravity"].why is Kept.AT_END


@pytest.mark.parametrize(("deviation", "told"), [(0.4, True), (0.6, False)])
def test_a_stiffness_whose_interval_holds_zero_is_not_told_from_none(
    chooser: Chooser, deviation: float, told: bool
) -> None:
    """Wherever its rest position may be."""
    spring = form(chooser, "spring")
    hypothesis = chooser.start.with_term(spring)
    at = hypothesis.start.copy()
    at[hypothesis.share(0)] = (1.0, 30.0)
    fit = Fit(hypothesis, at, np.zeros(0), 0.0, np.zeros((0, 0)), True)
    assert told_from_none(fit, 0, np.diag(np.full(len(at), deviation**2))) is told


@pytest.mark.parametrize(
    ("share", "torque", "worth"), [(0.04, 0.028, False), (0.01, 0.029, False), (0.05, 0.02, True), (0.0, 0.03, True)]
)
def test_a_finding_has_the_contracts_size(share: float, torque: float, worth: bool) -> None:
    assert of_size(Merit(share, 0.5, torque, 1e4), level=False) is worth
