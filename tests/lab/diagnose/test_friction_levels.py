"""Numbers of the model's own friction that are far off: found as levels, and no other effect is named for them."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest

from servod.formats.model.axis_model import AxisModel
from servod.lab.diagnose.data.intake import load_traces
from servod.lab.diagnose.document import diagnosis_document
from servod.lab.diagnose.effects import effect
from servod.lab.diagnose.effects.base import base_unknowns, document_of
from servod.lab.diagnose.effects.hypothesis import LEVEL, Hypothesis
from servod.lab.diagnose.effects.search_context import SearchContext
from servod.lab.diagnose.engine import diagnose
from servod.lab.diagnose.judge.conclude import differs_from_zero
from servod.lab.diagnose.predict.predict import Predictor
from servod.lab.diagnose.select.fit import Fit
from servod.lab.diagnose.select.levels import is_another
from tests.lab.diagnose.axes import BELIEVED, believed, record

Document = dict[str, Any]


def axis(inertia: float = 1.0, more: Document | None = None, **factors: float) -> AxisModel:
    """The believed axis with its numbers times factors."""
    document = copy.deepcopy(BELIEVED)
    document["inertia"] *= inertia
    for key, factor in factors.items():
        document["friction"][key] *= factor
    return AxisModel.model_validate(document | (more or {}))


def diagnosed(hidden: AxisModel) -> Document:
    return diagnosis_document(diagnose(believed(), record(hidden, seconds=4.0)))


def over_model(found: Document) -> dict[str, float]:
    """Findings by name, and how many times the model's own each is."""
    values = {one["effect"]: one["parameters"] for one in found["findings"]}
    return {name: some["over_model"]["value"] for name, some in values.items() if "over_model" in some}


def test_friction_and_mass_that_are_all_off_are_found_as_they_are() -> None:
    """Friction twice as viscous and 1.6 times as dry on 0.85 of the mass had other names, such as thermal."""
    found = diagnosed(axis(0.85, viscous=2.0, coulomb=1.6, static=1.6))
    assert {one["effect"] for one in found["findings"]} == {"dry_friction", "viscous_friction", "inertia"}
    assert over_model(found) == pytest.approx({"dry_friction": 1.6, "viscous_friction": 2.0}, rel=0.02)
    assert "Dry friction is not the model's: its level is off, 1.6 times what the model says" in found["summary"]
    assert found["recalibrated"].keys().isdisjoint(("friction.coulomb", "friction.static", "friction.viscous"))


@pytest.mark.parametrize("factors", [{"coulomb": 2.2, "static": 2.2}, {"viscous": 3.0}])
def test_one_level_alone_has_its_own_name(factors: dict[str, float]) -> None:
    found = diagnosed(axis(**factors))
    (one,) = found["findings"]
    assert one["effect"] == ("dry_friction" if "coulomb" in factors else "viscous_friction")
    low, high = one["parameters"]["over_model"]["interval"]
    assert low < next(iter(factors.values())) < high
    assert "asymmetry" not in [other["effect"] for other in one["alternatives"]]  # it would need the level as well


def test_below_its_level_friction_is_recalibrated() -> None:
    found = diagnosed(axis(viscous=1.15, coulomb=1.15, static=1.15))
    assert found["verdict"] == "adequate"
    assert found["minor"].keys().isdisjoint(("dry_friction", "viscous_friction"))
    for key in ("friction.coulomb", "friction.viscous"):
        change = found["recalibrated"][key]
        assert change["to"] == pytest.approx(1.15 * change["from"], rel=0.02)


def test_a_common_factor_on_all_torques_is_a_torque_gain() -> None:
    found = diagnosed(axis(more={"torque_gain": {"factor": 1.5}}))
    assert [one["effect"] for one in found["findings"]] == ["torque_gain"]


def test_a_common_factor_is_none_of_mass_and_all_friction_beside_a_weight() -> None:
    """Mass and both levels of friction explain no more than one factor does, with three numbers."""
    gain, weight = {"factor": 0.86}, {"amplitude": 0.1, "phase": 0.5}
    found = diagnosed(axis(1.03, more={"torque_gain": gain, "gravity": weight}))
    assert {one["effect"] for one in found["findings"]} == {"gravity", "torque_gain"}


def test_beside_a_gain_half_of_everything_is_no_stiffer_bristle() -> None:
    found = diagnosed(axis(more={"torque_gain": {"factor": 0.8}}, sigma0=3.0))
    assert {one["effect"] for one in found["findings"]} == {"torque_gain", "presliding"}


@pytest.mark.parametrize(("deviation", "told"), [(0.2, True), (0.6, False)])
def test_a_level_whose_interval_holds_the_models_own_is_no_finding(deviation: float, told: bool) -> None:
    """Nor is any term none of whose numbers is told from none by itself."""
    model = believed()
    predictor = Predictor(load_traces(record(model, seconds=2.0)[:1], model)[0], model)
    scene = SearchContext(document_of(model), predictor, np.zeros(len(predictor.counts)))
    base = Hypothesis(scene.document, base_unknowns(model))
    for name, numbers in (("dry_friction", (1.0,)), ("asymmetry", (1.0, 1.0))):
        hypothesis = base.with_term(effect(name).terms(scene)[0])
        at = hypothesis.start.copy()
        at[hypothesis.share(0)] = numbers
        fit = Fit(hypothesis, at, np.zeros(0), 0.0, np.zeros((0, 0)), True)
        covariance = np.diag(np.full(len(at), deviation**2))
        if len(numbers) > 1:  # sure together only: of their sum nothing is known, of their difference all
            one, other = range(hypothesis.share(0).start, hypothesis.share(0).stop)
            covariance[one, other] = covariance[other, one] = -0.99 * deviation**2
        assert differs_from_zero(fit, 0, covariance) is told
    assert hypothesis.unknowns[-1].key != LEVEL


def as_map() -> AxisModel:
    """The believed axis with its friction as an identification writes it: steady torques at speeds of both signs."""
    own = BELIEVED["friction"]
    speeds = np.geomspace(0.003, 4.0, 30)
    fall = np.exp(-((speeds / own["stribeck_velocity"]) ** 2))
    torques = own["coulomb"] + (own["static"] - own["coulomb"]) * fall + own["viscous"] * speeds
    friction = {
        "kind": "local",
        "velocities": [*(-speeds[::-1]), *speeds],
        "torques": [*(-torques[::-1]), *torques],
        **{key: own[key] for key in ("sigma0", "sigma1", "viscous")},
    }
    return AxisModel.model_validate(BELIEVED | {"friction": friction})


@pytest.mark.parametrize(
    ("factors", "levels"),
    [
        ({"coulomb": 0.6, "static": 0.6}, {"dry_friction": 0.6}),
        ({"coulomb": 1.6, "static": 1.6, "viscous": 1.6}, {"dry_friction": 1.6, "viscous_friction": 1.6}),
        ({}, {}),
    ],
)
def test_a_friction_map_has_levels_as_a_law_has(factors: dict[str, float], levels: dict[str, float]) -> None:
    found = diagnosis_document(diagnose(as_map(), record(axis(**factors), seconds=4.0)))
    assert found["verdict"] == ("missing_physics" if levels else "adequate")
    assert over_model(found) == pytest.approx(levels, rel=0.04)
    assert {one["effect"] for one in found["findings"]} == set(levels)


def test_a_maps_own_viscous_part_is_no_unknown() -> None:
    """Beside given torques it would only be another split of them, and levels would be factors on that."""
    assert "friction.viscous" in {unknown.key for unknown in base_unknowns(believed())}
    assert "friction.viscous" not in {unknown.key for unknown in base_unknowns(as_map())}


def test_what_a_map_is_off_by_less_is_told_as_recalibrated() -> None:
    found = diagnosis_document(diagnose(as_map(), record(axis(coulomb=1.2, static=1.2), seconds=4.0)))
    told = found["recalibrated"]["friction.dry_part"]
    assert (found["verdict"], told["from"]) == ("adequate", 1.0)
    assert told["to"] == pytest.approx(1.2, rel=0.02)
    assert "dry part is 1.2" in found["summary"]


@pytest.mark.parametrize(
    ("form", "numbers", "another"),
    [
        ("both, another level", (0.01, 0.02, np.log(1.6)), True),
        ("both, another level", (0.1, 0.0, np.log(1.6)), False),
        ("both, another level", (0.0, -0.1, np.log(1.6)), False),
        ("both", (0.02, 0.02), False),
    ],
)
def test_one_factor_on_both_directions_is_no_asymmetry(form: str, numbers: tuple[float, ...], another: bool) -> None:
    model = believed()
    predictor = Predictor(load_traces(record(model, seconds=2.0)[:1], model)[0], model)
    scene = SearchContext(document_of(model), predictor, np.zeros(len(predictor.counts)))
    forms = {term.form: term for term in effect("asymmetry").terms(scene)}
    hypothesis = Hypothesis(scene.document, base_unknowns(model)).with_term(forms[form])
    at = hypothesis.start.copy()
    at[hypothesis.share(0)] = numbers
    assert is_another(Fit(hypothesis, at, np.zeros(0), 0.0, np.zeros((0, 0)), True)) is another
