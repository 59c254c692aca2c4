"""Parameters with a level of their own: on their bound they are looked at, however little is left."""

from __future__ import annotations

import numpy as np
import pytest

from servod.lab.diagnose.data.intake import load_traces
from servod.lab.diagnose.effects import effect
from servod.lab.diagnose.effects.base import base_unknowns, document_of
from servod.lab.diagnose.effects.hypothesis import Document, Hypothesis
from servod.lab.diagnose.effects.search_context import SearchContext
from servod.lab.diagnose.predict.predict import Predictor
from servod.lab.diagnose.select.candidates import Candidate
from servod.lab.diagnose.select.fit import Fit
from servod.lab.diagnose.select.levels import is_level_change, level_at_bound
from servod.lab.diagnose.select.stepwise import worth_trying
from tests.lab.diagnose.axes import believed, record


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
    assert level_at_bound(fit_with(key, factor))
    assert not level_at_bound(fit_with(key, 1.05 if factor > 1.0 else 0.95))


def test_what_has_no_level_is_recalibrated_only() -> None:
    assert not level_at_bound(fit_with("friction.viscous", 2.0))
    assert not level_at_bound(fit_with("friction.stribeck_velocity", 3.0))


@pytest.fixture(scope="module")
def scene() -> SearchContext:
    """An axis with nothing left."""
    model = believed()
    predictor = Predictor(load_traces(record(model, seconds=3.0), model)[0], model)
    return SearchContext(document_of(model), predictor, np.zeros(len(predictor.counts)))


def test_levels_are_what_opens_the_models_own(scene: SearchContext) -> None:
    for name in ("stribeck", "presliding", "torque_offset", "inertia"):
        terms = effect(name).terms(scene)
        assert all(is_level_change(term) is (term.form != "fading damping") for term in terms) and len(terms) > 0
    for name in ("cogging", "delay", "actuator_lag", "viscous_nonlinear"):
        assert not any(is_level_change(term) for term in effect(name).terms(scene))


@pytest.mark.parametrize("name", ["stribeck", "presliding", "torque_offset", "inertia"])
def test_a_level_is_released_from_where_it_stands_too(scene: SearchContext, name: str) -> None:
    """Beside other effects the refit has gone most of the way: far starts must not be the only ones."""
    assert any(not term.begins and not term.unknowns for term in effect(name).terms(scene))


def test_friction_of_one_direction_alone_may_differ(scene: SearchContext) -> None:
    """Dry and viscous friction 0.72 of the model's backwards and the model's own forwards: both means are off."""
    term = next(t for t in effect("asymmetry").terms(scene) if t.form == "both, another level")
    document: Document = {}
    term.write(document, (0.28 / 1.72, 0.28 / 1.72, 0.86))
    expected = {"positive_dry": 1.0, "negative_dry": 0.72, "positive_viscous": 1.0, "negative_viscous": 0.72}
    assert document["asymmetry"] == pytest.approx(expected)


def test_beside_a_longer_delay_the_models_own_is_as_well_known_as_before(scene: SearchContext) -> None:
    """The two add up: without what is known of the model's own, nothing tells the share of either."""
    base = Hypothesis(scene.document, base_unknowns(believed()))
    for name in ("delay", "actuator_lag"):
        term = effect(name).terms(scene)[0]
        own = next(u for u in base.with_term(term).unknowns if u.key == "delay_s")
        assert own.spread == next(u for u in base.base if u.key == "delay_s").spread


def test_a_level_that_is_released_is_known_no_more(scene: SearchContext) -> None:
    base = Hypothesis(scene.document, base_unknowns(believed()))
    released = base.with_term(next(t for t in effect("inertia").terms(scene) if t.opens))
    assert np.isinf(next(u for u in released.unknowns if u.key == "inertia").spread)


def beside(present: Fit, scene: SearchContext, name: str, left: float) -> Candidate:
    """The first form of an effect that has no numbers to go wrong, beside a fit, and what it is said to leave."""
    hypothesis = present.hypothesis.with_term(effect(name).terms(scene)[0])
    at = hypothesis.beside(present.coordinates)
    return Candidate(name, Fit(hypothesis, at, np.zeros(0), 0.0, np.zeros((0, len(at))), True), left)


@pytest.mark.parametrize(("factor", "tried"), [(5.0, ["cogging", "torque_offset"]), (1.0, ["cogging"])])
def test_what_releases_a_level_on_its_bound_is_tried_however_little_it_takes(
    scene: SearchContext, factor: float, tried: list[str]
) -> None:
    """Beside a weight that takes up what it can of an offset, one step towards the offset takes next to nothing."""
    present = fit_with("torque_offset", factor)
    left = {"cogging": 0.87, "asymmetry": 0.92, "torque_offset": 0.93, "delay": 0.95}
    candidates = [beside(present, scene, name, share) for name, share in left.items()]
    assert [candidate.effect for candidate in worth_trying(present, candidates)] == tried
