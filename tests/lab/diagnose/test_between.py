"""What differs between recordings, and how far estimates may be off."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from servod.formats.model.axis_model import AxisModel
from servod.lab.diagnose.data.intake import load_traces
from servod.lab.diagnose.effects import effect
from servod.lab.diagnose.effects.base import base_unknowns, document_of
from servod.lab.diagnose.effects.effect import scale_friction
from servod.lab.diagnose.effects.hypothesis import Hypothesis
from servod.lab.diagnose.effects.search_context import SearchContext
from servod.lab.diagnose.effects.thermal import STILL_TO_GO
from servod.lab.diagnose.judge.covariance import common_factor, jackknife, model_error
from servod.lab.diagnose.predict.innovation_kernel import mean_command
from servod.lab.diagnose.predict.predict import Predictor
from servod.lab.diagnose.select.cross_validation import RECORDING, make_folds, predict_held_out
from servod.lab.diagnose.select.fit import Fit
from servod.lab.diagnose.select.selection import HeldOutErrors
from servod.lab.diagnose.select.selector import Selector
from servod.lab.recordings import Quantity
from tests.lab.diagnose.axes import believed, record

#: The form of the effect in which friction differs from recording to recording.
BETWEEN = "between recordings"


def with_friction(factor: float) -> AxisModel:
    friction = believed().friction.model_dump()
    return believed(friction=friction | {key: friction[key] * factor for key in ("coulomb", "static", "viscous")})


def in_order(*factors: float, temperature: bool = False) -> SearchContext:
    """Recordings with these factors on friction, and what an effect draws its start values from."""
    made = [record(with_friction(factor), seconds=3.0)[0] for factor in factors]
    if temperature:
        warm = {Quantity.TEMPERATURE: np.full(len(made[0]), 30.0)}
        made = [replace(one, columns={**one.columns, **warm}) for one in made]
    predictor = Predictor(load_traces(made, believed())[0], believed())
    return SearchContext(document_of(believed()), predictor, predictor.mismatch(believed()))


def colder(last: float) -> tuple[Predictor, Fit]:
    """Three recordings whose friction goes on to a level, and a fit in which it does."""
    scene = in_order(1.0, 1.0 + (last - 1.0) / (1.0 + STILL_TO_GO), last)
    term = next(term for term in effect("thermal").terms(scene) if term.form == BETWEEN)
    hypothesis = Hypothesis(document_of(believed()), base_unknowns(believed())).with_term(term)
    at = hypothesis.start.copy()
    at[hypothesis.share(0)] = [0.0, 0.0, last - 1.0, last - 1.0]
    mismatch = scene.predictor.mismatch(*hypothesis.models(at, 3))
    return scene.predictor, Fit(hypothesis, at, mismatch, 0.0, np.zeros((len(mismatch), len(at))), True)


def test_friction_may_go_on_from_recording_to_recording() -> None:
    predictor, fit = colder(1.3)
    assert np.std(predictor.mismatch(believed())) > 5.0 * np.std(fit.mismatch)
    first, _, last = fit.hypothesis.models(fit.coordinates, 3)
    assert last.friction.viscous == pytest.approx(1.3 * first.friction.viscous)


@pytest.mark.parametrize(
    ("factors", "temperature", "told"),
    [((1.0, 1.3), False, False), ((1.0, 1.2, 1.3), False, True), ((1.0, 1.2, 1.3), True, False)],
)
def test_only_an_order_in_time_says_that_it_was_time(factors: Any, temperature: bool, told: bool) -> None:
    """Not two recordings, whatever differs between them, nor those whose thermometer stands still."""
    forms = [term.form for term in effect("thermal").terms(in_order(*factors, temperature=temperature))]
    assert (BETWEEN in forms) is told


def test_what_is_not_in_order_is_no_warming_up() -> None:
    """Friction of the middle recording alone: its load, say. The others must say what it is, and cannot."""
    scene = in_order(1.0, 1.4, 1.0)
    term = next(term for term in effect("thermal").terms(scene) if term.form == BETWEEN)
    selector = Selector(scene.predictor, believed(), np.inf, lambda _line: None)
    base = selector.settle(selector.start, None, scene.mismatch)
    hypothesis = base.hypothesis.with_term(term)
    fit = selector.settle(hypothesis, hypothesis.beside(base.coordinates), base.mismatch)
    folds = make_folds(scene.predictor, fit)
    before, after = (predict_held_out(scene.predictor, one, folds).rms for one in (base, fit))
    assert folds.left_out == RECORDING
    assert after > 0.9 * before


def test_estimates_are_as_sure_as_recordings_agree() -> None:
    _, fit = colder(1.3)
    off = np.zeros_like(fit.coordinates)
    off[0] = 0.02
    held = HeldOutErrors(fit.mismatch, 0.0, (), (fit.coordinates + off, fit.coordinates - off))
    assert jackknife(fit, held)[0, 0] == pytest.approx(0.5 * 2 * 0.02**2)
    assert np.all(np.diag(model_error(fit))[:2] > 0.0)
    assert not common_factor(fit).any()


def test_an_unknown_gain_leaves_the_scale_to_what_was_known() -> None:
    scene_predictor, plain = colder(1.1)
    scene = SearchContext(document_of(believed()), scene_predictor, plain.mismatch)
    hypothesis = Hypothesis(document_of(believed()), base_unknowns(believed()))
    hypothesis = hypothesis.with_term(effect("torque_gain").terms(scene)[0])
    fit = Fit(hypothesis, hypothesis.start, plain.mismatch, 0.0, plain.jacobian[:, : len(hypothesis.start)], True)
    found = common_factor(fit)
    assert np.sqrt(found[-1, -1]) == pytest.approx(0.1 / np.sqrt(3.0))  # anything within 10 % is recalibration
    assert found[0, -1] == found[-1, -1]


def test_a_row_acts_under_the_mean_of_its_commands() -> None:
    t, torque = np.array([0.0, 1.0, 2.0, 3.0]) * 1e-3, [1.0, 3.0, 5.0, 7.0]
    row, command = mean_command(t, torque, 0.0, -1, 0.25e-3, 1e-3, 2e-3)
    assert row == 1
    assert command == pytest.approx(0.25 * 1.0 + 0.75 * 3.0)


def test_both_parts_of_a_map_go_on_from_recording_to_recording() -> None:
    """The torques of a map have dry and viscous friction in them: each part by its own factor."""
    document: dict[str, Any] = {
        "friction": {"kind": "local", "viscous": 0.5, "velocities": [-2.0, -0.1, 0.1, 2.0]}
        | {"torques": [-2.0, -1.05, 1.05, 2.0]}
    }
    scale_friction(document, 1.2, 2.0)
    assert document["friction"]["viscous"] == 1.0
    assert document["friction"]["torques"] == pytest.approx([-3.2, -1.3, 1.3, 3.2])
    scene = in_order(1.0, 1.1, 1.2)
    term = next(term for term in effect("thermal").terms(scene) if term.form == BETWEEN)
    assert term.each is not None
    term.each(document, (0.0, 0.0, 0.5, 0.0), 2)
    assert document["friction"]["torques"] == pytest.approx([-3.8, -1.9, 1.9, 3.8])
