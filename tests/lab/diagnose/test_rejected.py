"""What was rejected is in no model and explains nothing; a value on its bound is not told as measured."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from servod.formats.model.axis_model import AxisModel
from servod.lab.diagnose.judge.conclude import (
    extended_model,
    minor,
    name_findings,
    parameters,
    recalibrated,
    reject_terms,
)
from servod.lab.diagnose.judge.judgement import judge
from servod.lab.diagnose.judge.partial import best_model
from servod.lab.diagnose.predict.floor import above_noise
from servod.lab.diagnose.result import FreeRun, MinorReason, Windows
from servod.lab.diagnose.select.cross_validation import cross_validate
from servod.lab.diagnose.select.fit import on_bound
from servod.lab.diagnose.select.selector import Selector
from tests.lab.diagnose.axes import BELIEVED, believed
from tests.lab.diagnose.test_findings import form, selecting, sorted_with


@pytest.fixture(scope="module")
def selector() -> Selector:
    """An axis with a weight, whose dry friction is half as much again as believed."""
    friction = BELIEVED["friction"] | {"coulomb": 0.18, "static": 0.21}
    return selecting(believed(gravity={"amplitude": 0.1, "phase": 0.5}, friction=friction))


def test_a_term_at_the_end_of_its_range_is_in_no_model(selector: Selector) -> None:
    sine, cosine = form(selector, "gravity").unknowns
    narrow = replace(form(selector, "gravity"), unknowns=(replace(sine, low=-0.03, high=0.03), cosine))
    before = sorted_with(selector, narrow)
    selection = reject_terms(selector, before)
    assert selection is not None
    judgement = name_findings(selector, judge(selector, cross_validate(selector, selection)))
    assert before.fit.hypothesis.terms and not judgement.fit.hypothesis.terms
    assert extended_model(judgement, believed()).gravity is None
    assert judgement.errors.removed < 0.01 < before.errors.removed
    assert minor(judgement)["gravity"].why is MinorReason.AT_END


def test_a_value_on_its_bound_is_not_told_as_measured(selector: Selector) -> None:
    judgement = sorted_with(selector, form(selector, "gravity"))
    places = {unknown.key: place for place, unknown in enumerate(judgement.fit.hypothesis.base)}
    assert on_bound(judgement.fit)[places["friction.coulomb"]]
    assert "friction.coulomb" not in recalibrated(judgement)


def test_the_interval_of_a_number_on_its_bound_is_its_range(selector: Selector) -> None:
    """A bristle whose damping may be anything up to there."""
    judgement = sorted_with(selector, form(selector, "gravity"))
    hypothesis = judgement.fit.hypothesis.with_term(form(selector, "presliding"))
    fit = selector.settle(hypothesis, hypothesis.beside(judgement.fit.coordinates), judgement.fit.mismatch)
    place = next(i for i, unknown in enumerate(fit.hypothesis.base) if unknown.key == "friction.sigma1")
    at = fit.coordinates.copy()
    at[place] = fit.hypothesis.bounds[1][place]
    selection = replace(judgement.selection, fit=replace(fit, coordinates=at))
    judgement = replace(judgement, selection=selection, covariance=np.zeros((len(at), len(at))))
    found = parameters(judgement, [len(hypothesis.terms) - 1])["sigma1"]
    assert found.low < BELIEVED["friction"]["sigma1"] < found.value


def test_a_model_without_names_is_not_worse_than_it_came() -> None:
    rows = np.zeros(3)
    given, fitted = believed(), believed(inertia=0.05)
    for after, kept in ((0.9, fitted), (1.1, given)):
        run = FreeRun(1.0, after, after)
        window = Windows(0.25, run, {"run": run}, "run", rows, rows, rows + 1.0)
        model, (told,) = best_model(given, [(fitted, (window,))])
        assert model is kept
        assert told.errors.after == told.recordings["run"].after == min(after, 1.0)


@pytest.mark.parametrize("floor", [0.5, 1.0, 3.0])
def test_shares_stay_shares_where_the_floor_is_the_whole_error(floor: float) -> None:
    assert 1.0 / above_noise(1.0, floor) < 100.0


@pytest.mark.parametrize(("place", "stays"), [(0, True), (1, False)])
def test_what_is_not_told_from_none_stays_where_unseen_rows_need_it(
    selector: Selector, place: int, stays: bool
) -> None:
    """The weight, and a spring that is not there."""
    judgement = sorted_with(selector, form(selector, "gravity"), form(selector, "spring"))
    judgement = replace(judgement, kept={place: MinorReason.UNSURE})
    assert (reject_terms(selector, judgement) is None) is stays


def test_a_spring_without_stiffness_gives_way_to_the_offset_that_it_is() -> None:
    """It took all of the mismatch and had no name: an axis with half its friction as an offset was told as adequate."""
    selector = selecting(believed(torque_offset=0.06))
    judgement = sorted_with(selector, form(selector, "spring"))
    assert judgement.removed_share(0) > 0.9
    selection = reject_terms(selector, replace(judgement, named=(), kept={0: MinorReason.UNSURE}))
    assert selection is not None and not selection.fit.hypothesis.terms


@pytest.mark.parametrize(("effect", "stays"), [("gravity", True), ("backlash", False), ("joint_elasticity", False)])
def test_a_resonance_that_is_too_small_for_a_name_is_in_no_model(selector: Selector, effect: str, stays: bool) -> None:
    """A feedback would have to be stable with it."""
    judgement = sorted_with(selector, form(selector, effect))
    judgement = replace(judgement, named=(), kept={0: MinorReason.SMALL})
    assert (reject_terms(selector, judgement) is None) is stays


def test_judging_again_changes_nothing_that_stands(selector: Selector) -> None:
    judgement = sorted_with(selector, form(selector, "gravity"))
    assert reject_terms(selector, judgement) is None
    assert isinstance(extended_model(judgement, believed()), AxisModel)
    assert name_findings(selector, judge(selector, judgement.selection)).named == judgement.named
