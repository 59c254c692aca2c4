"""Every effect: its file is complete, its starts are models, and what it writes can be loaded again."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from servod.common.yaml import parse_yaml, validate
from servod.formats.model.axis_model import AxisModel, axis_model_yaml
from servod.formats.model.drive import DriveLaw
from servod.lab.diagnose import effects as package
from servod.lab.diagnose.data.intake import load_traces
from servod.lab.diagnose.effects import NAMES, effect, effects, fitted_elsewhere, names, unexcited_effects
from servod.lab.diagnose.effects.base import base_unknowns, document_of
from servod.lab.diagnose.effects.effect import Effect, simple
from servod.lab.diagnose.effects.hypothesis import Hypothesis, Unknown
from servod.lab.diagnose.effects.looks import Look
from servod.lab.diagnose.effects.search_context import SearchContext
from servod.lab.diagnose.explain import explain_effect, list_effects
from servod.lab.diagnose.judge.covariance import common_factor
from servod.lab.diagnose.judge.verdict import alternatives
from servod.lab.diagnose.predict.predict import Predictor
from servod.lab.diagnose.select.fit import Fit
from servod.lab.diagnose.select.levels import named_terms
from servod.lab.diagnose.select.selection import Selection, TermEntry
from servod.lab.diagnose.select.selector import once_only
from tests.lab.diagnose.axes import believed, record
from tests.lab.simulate.servo_axis import ServoAxis
from tests.lab.simulate.test_servo import model_of, recorded


@functools.cache
def scene() -> SearchContext:
    model = believed(gravity={"amplitude": 0.1, "phase": 0.2})
    traces, _ = load_traces(record(model), model)
    predictor = Predictor(traces, model)
    return SearchContext(document_of(model), predictor, predictor.mismatch(believed()))


@functools.cache
def servo_scene(folder: Path) -> SearchContext:
    """Of recordings with a goal in place of a torque."""
    axis = ServoAxis(coulomb=0.06)
    model = model_of(axis)
    traces, _ = load_traces([recorded(axis, folder, kind=2)], model)
    predictor = Predictor(traces, model)
    return SearchContext(document_of(model), predictor, predictor.mismatch(model))


def test_a_wave_that_is_turned_on_is_the_sine_of_its_order() -> None:
    seen, orders = scene(), np.linspace(0.7, 130.0, 2500)
    place = seen.lagged_position[seen.thinned]
    pairs = list(seen.pairs(lambda n, sine, cosine: (sine + 0.0, cosine + 0.0), orders))
    for n, (sine, cosine) in pairs[::100] + pairs[-1:]:
        assert sine == pytest.approx(np.sin(n * place), abs=1e-9)
        assert cosine == pytest.approx(np.cos(n * place), abs=1e-9)
    (alone,) = seen.pairs(lambda n, sine, cosine: (sine, cosine), orders[:1])
    assert alone[1][0] == pytest.approx(np.sin(0.7 * place), abs=1e-12)


@pytest.mark.parametrize("name", NAMES)
def test_starts_are_models(name: str, tmp_path_factory: pytest.TempPathFactory) -> None:
    on_drive = bool(effect(name).drive_keys)
    seen = servo_scene(tmp_path_factory.getbasetemp()) if on_drive else scene()
    model = AxisModel.model_validate(seen.document)
    base = Hypothesis(document_of(model), base_unknowns(model))
    terms = effect(name).terms(seen)
    assert not on_drive or not effect(name).terms(scene())  # a recorded torque is behind the drive
    assert terms
    for term in terms:
        hypothesis = base.with_term(term)
        at = hypothesis.beside(base.start)
        low, high = hypothesis.bounds
        assert np.all(at >= low - 1e-9)
        assert np.all(at <= high + 1e-9)
        found = hypothesis.model(at)
        assert validate(parse_yaml(axis_model_yaml(found), "model"), AxisModel, "model") == found
        assert term.report(hypothesis.written(at), hypothesis.values(at)[hypothesis.share(0)])


@pytest.mark.parametrize("name", NAMES)
def test_explained(name: str) -> None:
    found = explain_effect(name)
    assert found["keys"]
    assert all(found[key] for key in ("statement", "equation", "source", "shows", "experiment"))
    assert set(found["confused_with"]) <= set(NAMES)
    assert name not in found["confused_with"]


def test_every_number_of_a_spring_has_its_own_unit() -> None:
    for term in effect("spring").terms(scene()):
        told = {r.name: r.unit for r in term.report(scene().document, [u.start for u in term.unknowns])}
        assert told["stiffness"] == "N·m/rad"
        assert told["rest"] == "rad"
        assert told.get("cubic", "N·m/rad·1/rad²") == "N·m/rad·1/rad²"


def test_a_gain_is_not_tried_beside_a_number_of_the_drive_that_is_one_with_it() -> None:
    levels = {"dry_friction", "viscous_friction"}  # friction is free beside such a number
    assert fitted_elsewhere(frozenset(("drive.torque_per_command",))) == {"torque_gain", *levels}
    assert fitted_elsewhere(frozenset(("drive.kp", "drive.emf_viscous"))) == {"torque_gain", "drive_gain", *levels}
    assert not fitted_elsewhere(frozenset())


@pytest.mark.parametrize("name", NAMES)
def test_a_record_has_the_name_of_its_file_and_the_group_of_its_key(name: str) -> None:
    found = effect(name)
    assert found.name == name
    assert found.twin in {"", *NAMES} and bool(found.twin) == bool(found.lateness)
    if found.drive_keys:
        assert found.group is None and set(found.drive_keys) <= set(DriveLaw.model_fields)
        return
    if found.group is None and found.friction_keys:  # a level of the model's own friction
        assert name not in AxisModel.model_fields
        return
    annotation = AxisModel.model_fields[name].annotation
    assert annotation is float if found.group is None else annotation == found.group | None


@pytest.fixture
def add(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[Effect], None]]:
    """Adds a record as a new file and one line would."""

    def added(record: Effect) -> None:
        module = ModuleType(f"{package.__name__}.{record.name}")
        module.EFFECT = record  # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, module.__name__, module)
        monkeypatch.setattr(package, "NAMES", (*NAMES, record.name))

    yield added
    effect.cache_clear()


def test_a_new_record_is_in_every_list(add: Callable[[Effect], None]) -> None:
    stiffness = simple("toy", "straight", [Unknown("stiffness", "N·m/rad", 0.1, 0.0, 1.0, 0.1)])
    twin = simple("spring", "straight", stiffness.unknowns)
    record = replace(effect("spring"), name="toy", terms=lambda _scene: [stiffness], look=Look("load"))
    flags = {"swift": True, "directed": True, "repeatable": True, "soaks_up": True, "scales_torques": True}
    levels = {"at_level": lambda _nominal, fitted: fitted["toy"]["stiffness"] > 0.5, "twin": "spring"}
    add(replace(record, friction_keys=("sigma0",), lateness="toy.stiffness", **flags, **levels))

    assert effects()[-1] is effect("toy") and "toy" in list_effects()
    keys = [key["key"] for key in explain_effect("toy")["keys"]]
    assert keys == ["toy.stiffness", "toy.rest", "toy.cubic", "friction.sigma0"]
    assert all("toy" in names(lambda what, flag=flag: getattr(what, flag)) for flag in flags)
    predictor = scene().predictor
    assert "toy" in unexcited_effects(predictor.traces, 1e-4) and "toy" not in unexcited_effects(
        predictor.traces, scene().inertia
    )

    hypothesis = Hypothesis(scene().document, base_unknowns(believed()), (stiffness, twin))
    assert once_only(hypothesis) == {"spring"}
    for value, named in ((0.2, (1,)), (0.9, (0, 1))):
        coordinates = hypothesis.start.copy()
        coordinates[hypothesis.share(0)] = stiffness.unknowns[0].coordinate(value)
        fit = Fit(hypothesis, coordinates, scene().mismatch, 0.0, np.zeros((0, 0)), True)
        selection = Selection(fit, fit, 0.0, 0.0, (), (TermEntry(0.1, ()), TermEntry(0.1, ())))
        assert named_terms(fit, scene().document) == named
        assert alternatives(selection, 0) == ["spring"]
        assert common_factor(fit)[hypothesis.share(0)].any()
