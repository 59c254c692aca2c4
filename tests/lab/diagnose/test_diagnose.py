"""Whole diagnoses on axes that conceal something, and the files that the command writes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from servod.cli.app import app
from servod.formats.model.axis_model import axis_model_yaml, load_axis_model
from servod.lab.diagnose.document import diagnosis_document
from servod.lab.diagnose.engine import diagnose
from tests.lab.diagnose.axes import believed, record, write_csv


def found_in(seed: int = 1, off: float = 1.0, **hidden: Any) -> dict[str, Any]:
    """The document of a diagnosis of an axis with `hidden`; the model's inertia is `off` by a factor."""
    model = believed(inertia=0.02 * off)
    found = diagnose(model, record(believed(**hidden), seed=seed))
    assert found.evidence is not None
    return diagnosis_document(found)


def test_nothing_hidden_is_adequate_and_the_model_holds_what_is_told() -> None:
    model = believed(inertia=0.02 * 1.03)
    found = diagnose(model, record(believed()))
    assert found.evidence is not None
    document, extended = diagnosis_document(found), found.evidence.model
    assert document["verdict"] == "adequate"
    assert document["findings"] == []
    changed = document["recalibrated"]
    assert changed["inertia"]["to"] == pytest.approx(0.02, rel=0.005)
    assert extended.inertia == changed["inertia"]["to"]
    for key, value in model.friction.model_dump().items():
        to = changed.get(f"friction.{key}", {"to": value})["to"]
        assert getattr(extended.friction, key) == (pytest.approx(to, rel=1e-9) if key != "kind" else to)


def test_asymmetry_is_named() -> None:
    document = found_in(asymmetry={"positive_dry": 1.15, "negative_dry": 0.85})
    assert [finding["effect"] for finding in document["findings"]] == ["asymmetry"]
    finding = document["findings"][0]
    ratio = finding["parameters"]["negative_over_positive"]
    assert ratio["value"] == pytest.approx(0.85 / 1.15, rel=0.03)
    assert ratio["interval"][0] < ratio["value"] < ratio["interval"][1]
    assert finding["confidence"] > 0.8
    assert finding["held_out"]["after"] < 0.2 * finding["held_out"]["before"]
    windows = document["fit"]["windows"]["0.25"]
    assert windows["after"] < 0.3 * windows["before"]


def test_time_that_ends_before_the_search_is_no_finding() -> None:
    """A limit that is over after the base's fit: not `unexplained`, which would say that physics was looked for."""
    found = diagnose(believed(), record(believed(gravity={"amplitude": 0.15, "phase": 0.5}), seconds=3.0), 1e-3)
    document = diagnosis_document(found)
    assert document["verdict"] == "cannot_tell"
    assert document["findings"] == []
    assert document["fit"]["starts_tried"] == 0
    assert "before any physics was tried" in document["summary"]


def test_command_writes_both_files(tmp_path: Path) -> None:
    for index, made in enumerate(record(believed(gravity={"amplitude": 0.15, "phase": 0.5}))):
        write_csv(made, tmp_path / f"run{index}.csv")
    (tmp_path / "model.yaml").write_text(axis_model_yaml(believed()))
    names = [str(tmp_path / f"run{index}.csv") for index in range(3)]
    out = tmp_path / "out"
    run = CliRunner().invoke(
        app, ["diagnose", "--model", str(tmp_path / "model.yaml"), *names, "--out", str(out), "--json"]
    )
    assert run.exit_code == 0, run.output
    document = json.loads((out / "diagnosis.json").read_text())
    assert json.loads(run.stdout) == document
    assert document["verdict"] == "missing_physics"
    assert [finding["effect"] for finding in document["findings"]] == ["gravity"]
    extended = load_axis_model(out / "model.yaml")
    assert extended.gravity is not None
    assert extended.gravity.amplitude == pytest.approx(0.15, rel=0.02)
