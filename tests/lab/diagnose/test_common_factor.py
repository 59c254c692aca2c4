"""The common factor on all torques beside an unknown gain: flat in the data, and where it was believed to be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from servod.lab.diagnose.data.intake import load_traces
from servod.lab.diagnose.effects import effect
from servod.lab.diagnose.effects.search_context import SearchContext
from servod.lab.diagnose.predict.predict import Predictor
from servod.lab.diagnose.select.common_factor import along_factor, believed_factor
from servod.lab.diagnose.select.fit import Fit
from servod.lab.diagnose.select.selector import Selector
from tests.lab.diagnose.axes import believed, record

HIDDEN = {"torque_gain": {"factor": 1.15}, "gravity": {"amplitude": 0.1, "phase": 0.5}}


@pytest.fixture(scope="module")
def selector() -> Selector:
    predictor = Predictor(load_traces(record(believed(**HIDDEN), seconds=2.0), believed())[0], believed())
    return Selector(predictor, believed(), 1e12, lambda _line: None)


@pytest.fixture(scope="module")
def fitted(selector: Selector) -> Fit:
    """A weight, whose numbers are multiples of a size, and a gain."""
    fit = selector.fit_base().fit
    for name in ("gravity", "torque_gain"):
        scene = SearchContext(selector.start.document, selector.predictor, fit.mismatch)
        hypothesis = fit.hypothesis.with_term(effect(name).terms(scene)[0])
        fit = selector.settle(hypothesis, hypothesis.beside(fit.coordinates), fit.mismatch)
    return selector.polished(fit)


def moved(fit: Fit, factor: float) -> np.ndarray:
    """The coordinates with every torque, and the gain, times the same factor."""
    along = along_factor(fit.hypothesis, fit.coordinates)
    assert along is not None
    straight = np.array([unknown.size != 0.0 for unknown in fit.hypothesis.unknowns])
    return np.where(straight & (along != 0.0), fit.coordinates * factor, fit.coordinates + np.log(factor) * along)


@pytest.mark.parametrize("factor", [0.97, 1.03])
def test_no_recording_tells_it(selector: Selector, fitted: Fit, factor: float) -> None:
    there = selector.fitter(fitted.mismatch).mismatch(fitted.hypothesis, moved(fitted, factor))
    assert there is not None
    assert np.std(there - fitted.mismatch) < 0.01 * np.std(fitted.mismatch)


@pytest.mark.parametrize("factor", [0.95, 1.04])
def test_a_fit_ends_where_it_was_believed_whatever_it_came_from(selector: Selector, fitted: Fit, factor: float) -> None:
    fitter, off = selector.fitter(fitted.mismatch), moved(fitted, factor)
    cost = fitter.cost(fitted.hypothesis, off, fitted.mismatch)
    ended = fitter.refine(replace(fitted, coordinates=off, cost=cost), 0)
    assert ended.coordinates == pytest.approx(fitted.coordinates, abs=2e-3)
    gain = ended.values[-1]
    assert gain == pytest.approx(1.15, rel=0.01)


def test_without_a_gain_recordings_tell_every_torque(selector: Selector) -> None:
    base = selector.fit_base().fit
    assert along_factor(base.hypothesis, base.coordinates) is None
    assert believed_factor(base.hypothesis, base.coordinates) is None
