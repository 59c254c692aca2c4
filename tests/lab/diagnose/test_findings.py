"""Terms that stay in the model and are no findings: too small, under their level, at an end, not told from none."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from servod.formats.model.axis_model import AxisModel
from servod.lab.diagnose.data.intake import load_traces
from servod.lab.diagnose.effects import effect
from servod.lab.diagnose.effects.hypothesis import Term
from servod.lab.diagnose.effects.search_context import SearchContext
from servod.lab.diagnose.judge.conclude import differs_from_zero, exceeds_command, minor, name_findings, plainer_form
from servod.lab.diagnose.judge.judgement import JudgedSelection, judge
from servod.lab.diagnose.predict.predict import Predictor
from servod.lab.diagnose.result import MinorReason
from servod.lab.diagnose.select.cross_validation import cross_validate
from servod.lab.diagnose.select.fit import Fit
from servod.lab.diagnose.select.levels import at_end_of_range
from servod.lab.diagnose.select.merit import Merit, large_enough
from servod.lab.diagnose.select.selection import Selection, TermEntry
from servod.lab.diagnose.select.selector import Selector
from tests.lab.diagnose.axes import believed, record

#: What a term is said to be worth before anybody has looked.
UNKNOWN = Merit(math.nan, math.nan, math.nan, math.nan)


def selecting(hidden: AxisModel) -> Selector:
    """The selection on an axis that conceals something."""
    predictor = Predictor(load_traces(record(hidden, seconds=2.0)[:2], believed())[0], believed())
    return Selector(predictor, believed(), math.inf, lambda _line: None)


@pytest.fixture(scope="module")
def selector() -> Selector:
    """An axis with a weight, and with a hundredth of its dry friction growing with the square of the speed."""
    return selecting(believed(gravity={"amplitude": 0.1, "phase": 0.5}, viscous_nonlinear={"quadratic": 3e-4}))


def form(selector: Selector, name: str) -> Term:
    """The first form of an effect."""
    mismatch = selector.predictor.mismatch(believed())
    return effect(name).terms(SearchContext(selector.start.document, selector.predictor, mismatch))[0]


def sorted_with(selector: Selector, *terms: Term) -> JudgedSelection:
    """The judgement of these terms, fitted together."""
    base = selector.settle(selector.start, None, selector.predictor.mismatch(believed()))
    fit = base
    for term in terms:
        hypothesis = fit.hypothesis.with_term(term)
        fit = selector.settle(hypothesis, hypothesis.beside(fit.coordinates), fit.mismatch)
    error = selector.error(selector.predictor.mismatch(believed()))
    merits, entries = (UNKNOWN,) * len(terms), (TermEntry(0.1, ()),) * len(terms)
    selection = Selection(base, fit, error, 0.0, merits, entries, {"gravity": UNKNOWN}, tried=1)
    return name_findings(selector, judge(selector, cross_validate(selector, selection)))


def test_what_is_small_or_under_its_level_stays_in_the_model_and_is_told(selector: Selector) -> None:
    terms = [form(selector, name) for name in ("gravity", "torque_gain", "viscous_nonlinear")]
    judgement = sorted_with(selector, *terms)
    assert judgement.named == (0,)
    assert judgement.kept == {1: MinorReason.LEVEL, 2: MinorReason.SMALL}
    told = minor(judgement)
    assert list(told) == ["viscous_nonlinear", "torque_gain"]
    parameters = told["torque_gain"].parameters
    assert parameters is not None
    assert parameters["factor"].low < parameters["factor"].value < parameters["factor"].high
    assert judgement.selection.merits[0].share > 0.7


def test_what_ends_at_the_end_of_a_range_is_no_finding(selector: Selector) -> None:
    sine, cosine = form(selector, "gravity").unknowns
    narrow = replace(form(selector, "gravity"), unknowns=(replace(sine, low=-0.08, high=0.08), cosine))
    judgement = sorted_with(selector, narrow)
    assert judgement.named == ()
    assert judgement.kept == {0: MinorReason.AT_END}
    assert minor(judgement)["gravity"].why is MinorReason.AT_END


@pytest.mark.parametrize(("times", "beyond"), [(3.0, False), (30.0, True)])
def test_no_effect_takes_many_times_the_largest_command(selector: Selector, times: float, beyond: bool) -> None:
    """Nothing in the recordings holds against it: the command is in another unit than the motion."""
    judgement = sorted_with(selector, form(selector, "gravity"))
    predictor = judgement.predictor
    own = times * float(np.max(np.abs(predictor.over("torque")))) / predictor.dry
    merit = replace(judgement.selection.merits[0], own=own)
    judgement = replace(judgement, selection=judgement.selection.with_merit(0, merit))
    assert exceeds_command(judgement, 0) is beyond


def test_numbers_that_are_sure_together_alone_give_way_to_a_plainer_form(selector: Selector) -> None:
    """Two curves at once, where one of them is there."""
    scene = SearchContext(selector.start.document, selector.predictor, selector.predictor.mismatch(believed()))
    both = next(term for term in effect("viscous_nonlinear").terms(scene) if term.form == "quadratic and cubic")
    fit = base = selector.settle(selector.start, None, selector.predictor.mismatch(believed()))
    for term in (form(selector, "gravity"), both):
        hypothesis = fit.hypothesis.with_term(term)
        fit = selector.settle(hypothesis, hypothesis.beside(fit.coordinates), fit.mismatch)
    plainer = plainer_form(selector, Selection(base, fit, 1.0, 0.0), 1)
    assert plainer is not None
    kept, given = plainer.fit.hypothesis.terms
    assert kept.effect == "gravity" and given.effect == both.effect and given.numbers < both.numbers
    assert plainer_form(selector, plainer, 1) is None


def test_a_spring_may_rest_beyond_what_is_searched(selector: Selector) -> None:
    """It is a constant force and a slope then, and no other effect's shape."""
    mismatch = selector.predictor.mismatch(believed())
    scene = SearchContext(selector.start.document, selector.predictor, mismatch)
    stiffening = next(term for term in effect("spring").terms(scene) if term.form == "stiffening")
    hypothesis = selector.start.with_term(stiffening)
    at, share = hypothesis.start.copy(), hypothesis.share(0)
    at[share] = (0.2, hypothesis.bounds[0][share][1], 0.0)
    assert not at_end_of_range(Fit(hypothesis, at, np.zeros(0), 0.0, np.zeros((0, 0)), True))


@pytest.mark.parametrize(("deviation", "told"), [(0.4, True), (0.6, False)])
def test_a_stiffness_whose_interval_holds_zero_is_not_differs_from_zero(
    selector: Selector, deviation: float, told: bool
) -> None:
    """Wherever its rest position may be."""
    spring = form(selector, "spring")
    hypothesis = selector.start.with_term(spring)
    at = hypothesis.start.copy()
    at[hypothesis.share(0)] = (1.0, 30.0)
    fit = Fit(hypothesis, at, np.zeros(0), 0.0, np.zeros((0, 0)), True)
    assert differs_from_zero(fit, 0, np.diag(np.full(len(at), deviation**2))) is told


@pytest.mark.parametrize(
    ("share", "torque", "worth"), [(0.04, 0.028, False), (0.01, 0.029, False), (0.05, 0.02, True), (0.0, 0.03, True)]
)
def test_a_finding_has_the_contracts_size(share: float, torque: float, worth: bool) -> None:
    assert large_enough(Merit(share, 0.5, torque, 1e4), level=False) is worth
