"""What differs between recordings, and how far estimates may be off."""

from __future__ import annotations

import numpy as np
import pytest

from servod.lab.diagnose.data.intake import load_traces
from servod.lab.diagnose.effects import effect
from servod.lab.diagnose.effects.base import base_unknowns, document_of
from servod.lab.diagnose.effects.hypothesis import Hypothesis
from servod.lab.diagnose.effects.search_context import SearchContext
from servod.lab.diagnose.judge.covariance import common_factor, jackknife, model_error
from servod.lab.diagnose.predict.innovation_kernel import mean_command
from servod.lab.diagnose.predict.predict import Predictor
from servod.lab.diagnose.select.fit import Fit
from servod.lab.diagnose.select.selection import HeldOutErrors
from tests.lab.diagnose.axes import believed, record


def colder(first: float, second: float) -> tuple[Predictor, Fit]:
    """Two recordings, the second with more friction, and a fit with a level of friction for each recording."""
    friction = believed().friction.model_dump()
    more = friction | {key: friction[key] * second / first for key in ("coulomb", "static", "viscous")}
    made = [record(believed())[0], record(believed(friction=more))[0]]
    predictor = Predictor(load_traces(made, believed())[0], believed())
    scene = SearchContext(document_of(believed()), predictor, predictor.mismatch(believed()))
    term = next(term for term in effect("thermal").terms(scene) if term.form == "between recordings")
    hypothesis = Hypothesis(document_of(believed()), base_unknowns(believed())).with_term(term)
    at = hypothesis.start.copy()
    at[hypothesis.share(0)] = [0.0, 0.0, second / first - 1.0, second / first - 1.0]
    mismatch = predictor.mismatch(*hypothesis.models(at, 2))
    return predictor, Fit(hypothesis, at, mismatch, 0.0, np.zeros((len(mismatch), len(at))), True)


def test_friction_may_differ_between_recordings() -> None:
    predictor, fit = colder(1.0, 1.3)
    assert np.std(predictor.mismatch(believed())) > 5.0 * np.std(fit.mismatch)
    first, second = fit.hypothesis.models(fit.coordinates, 2)
    assert second.friction.viscous == pytest.approx(1.3 * first.friction.viscous)


def test_estimates_are_as_sure_as_recordings_agree() -> None:
    _, fit = colder(1.0, 1.3)
    off = np.zeros_like(fit.coordinates)
    off[0] = 0.02
    held = HeldOutErrors(fit.mismatch, 0.0, (), (fit.coordinates + off, fit.coordinates - off))
    assert jackknife(fit, held)[0, 0] == pytest.approx(0.5 * 2 * 0.02**2)
    assert np.all(np.diag(model_error(fit))[:2] > 0.0)
    assert not common_factor(fit).any()


def test_an_unknown_gain_leaves_the_scale_to_what_was_known() -> None:
    scene_predictor, plain = colder(1.0, 1.1)
    scene = SearchContext(document_of(believed()), scene_predictor, plain.mismatch)
    hypothesis = Hypothesis(document_of(believed()), base_unknowns(believed()))
    hypothesis = hypothesis.with_term(effect("torque_gain").terms(scene)[0])
    fit = Fit(hypothesis, hypothesis.start, plain.mismatch, 0.0, plain.jacobian[:, : len(hypothesis.start)], True)
    found = common_factor(fit)
    assert 0.01 < np.sqrt(found[-1, -1]) < 0.04
    assert found[0, -1] == found[-1, -1]


def test_a_row_acts_under_the_mean_of_its_commands() -> None:
    t, torque = np.array([0.0, 1.0, 2.0, 3.0]) * 1e-3, [1.0, 3.0, 5.0, 7.0]
    row, command = mean_command(t, torque, 0.0, -1, 0.25e-3, 1e-3, 2e-3)
    assert row == 1
    assert command == pytest.approx(0.25 * 1.0 + 0.75 * 3.0)
