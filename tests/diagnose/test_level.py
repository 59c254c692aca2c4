"""Parameters with a level of their own: on their bound they are looked at, however little is left."""

from __future__ import annotations

import numpy as np
import pytest

from servod.diagnose.base import base_unknowns, document_of
from servod.diagnose.effects import effect
from servod.diagnose.fit import Fit
from servod.diagnose.hypothesis import Hypothesis
from servod.diagnose.intake import taken_in
from servod.diagnose.level import is_level, on_bound
from servod.diagnose.predict import Predictor
from servod.diagnose.scene import Scene
from tests.diagnose.axes import believed, record


def fit_with(key: str, factor: float) -> Fit:
    """A fit of the base alone in which one parameter has been pulled by a factor, as far as its bound lets it."""
    hypothesis = Hypothesis(document_of(believed()), base_unknowns(believed()))
    at = hypothesis.start.copy()
    place = [unknown.key for unknown in hypothesis.base].index(key)
    at[place] += np.log(factor)
    nothing = np.zeros(0)
    return Fit(hypothesis, np.clip(at, *hypothesis.bounds), nothing, 0.0, np.zeros((0, len(at))), True)


@pytest.mark.parametrize("key", ["friction.sigma0", "friction.sigma1", "friction.static", "inertia"])
@pytest.mark.parametrize("factor", [0.2, 5.0])
def test_a_parameter_pulled_beyond_its_level_stands_on_its_bound(key: str, factor: float) -> None:
    assert on_bound(fit_with(key, factor))
    assert not on_bound(fit_with(key, 1.05 if factor > 1.0 else 0.95))


def test_what_has_no_level_is_recalibrated_only() -> None:
    assert not on_bound(fit_with("friction.viscous", 2.0))
    assert not on_bound(fit_with("friction.stribeck_velocity", 3.0))


def test_levels_are_what_opens_the_models_own() -> None:
    model = believed()
    predictor = Predictor(taken_in(record(model, seconds=3.0), model)[0], model)
    scene = Scene(document_of(model), predictor, np.zeros(len(predictor.counts)))
    for name in ("stribeck", "presliding", "torque_offset", "inertia"):
        assert all(is_level(term) for term in effect(name).terms(scene))
    for name in ("cogging", "delay", "actuator_lag", "viscous_nonlinear"):
        assert not any(is_level(term) for term in effect(name).terms(scene))
