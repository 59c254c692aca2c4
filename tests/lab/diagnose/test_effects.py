"""Every effect: its file is complete, its starts are models, and what it writes can be loaded again."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from servod.common.yaml import parse_yaml, validate
from servod.formats.model.axis_model import AxisModel, axis_model_yaml
from servod.lab.diagnose.data.intake import load_traces
from servod.lab.diagnose.effects import NAMES, effect
from servod.lab.diagnose.effects.base import base_unknowns, document_of
from servod.lab.diagnose.effects.hypothesis import Hypothesis
from servod.lab.diagnose.effects.scene import Scene
from servod.lab.diagnose.explain import explain_effect
from servod.lab.diagnose.predict.predict import Predictor
from tests.lab.diagnose.axes import believed, record


@functools.cache
def scene() -> Scene:
    model = believed(gravity={"amplitude": 0.1, "phase": 0.2})
    traces, _ = load_traces(record(model), model)
    predictor = Predictor(traces, model)
    return Scene(document_of(model), predictor, predictor.mismatch(believed()))


@pytest.mark.parametrize("name", NAMES)
def test_starts_are_models(name: str) -> None:
    model = believed(gravity={"amplitude": 0.1, "phase": 0.2})
    base = Hypothesis(document_of(model), base_unknowns(model))
    terms = effect(name).terms(scene())
    assert terms
    for term in terms:
        hypothesis = base.with_term(term)
        at = hypothesis.beside(base.start)
        low, high = hypothesis.bounds
        assert np.all(at >= low - 1e-9)
        assert np.all(at <= high + 1e-9)
        found = hypothesis.model(at)
        assert validate(parse_yaml(axis_model_yaml(found), "model"), AxisModel, "model") == found
        assert term.tell(hypothesis.written(at), hypothesis.values(at)[hypothesis.share(0)])


@pytest.mark.parametrize("name", NAMES)
def test_explained(name: str) -> None:
    found = explain_effect(name)
    assert found["keys"]
    assert all(found[key] for key in ("statement", "equation", "source", "shows", "experiment"))
    assert set(found["confused_with"]) <= set(NAMES)
    assert name not in found["confused_with"]


def test_every_number_of_a_spring_has_its_own_unit() -> None:
    for term in effect("spring").terms(scene()):
        told = {r.name: r.unit for r in term.tell(scene().document, [u.start for u in term.unknowns])}
        assert told["stiffness"] == "N·m/rad"
        assert told["rest"] == "rad"
        assert told.get("cubic", "N·m/rad·1/rad²") == "N·m/rad·1/rad²"
