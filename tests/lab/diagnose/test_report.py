"""The page of a diagnosis: one file without a network, sentences first, pictures as PNG; and the document's keys."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from servod.cli.app import run
from servod.formats.model.axis_model import AxisKind, axis_model_yaml, load_axis_model
from servod.lab.diagnose.data.intake import load_traces
from servod.lab.diagnose.document import describe_fit, describe_place
from servod.lab.diagnose.effects import effects
from servod.lab.diagnose.engine import diagnose
from servod.lab.diagnose.judge.locate import maps
from servod.lab.diagnose.predict.predict import Predictor
from servod.lab.recordings import Quantity, Recording
from servod.lab.report.diagnosis import write_files
from tests.lab.diagnose.axes import BELIEVED, believed, record, recording, write_csv

pytestmark = pytest.mark.timeout(400)  # some 10 s on a quiet core; a busy machine is no finding

#: Keys of the outside contract.
FINDING = {"effect", "statement", "located", "parameters", "confidence", "alternatives", "held_out"}
TOP = {"verdict", "findings", "recalibrated", "minor", "fit", "recordings"}


def linear(made: Recording) -> Recording:
    """The same numbers on an axis that moves in metres."""
    return Recording(made.path, AxisKind.LINEAR, made.columns, made.measured, made.report)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """A linear axis with a spring, diagnosed and written."""
    folder = tmp_path_factory.mktemp("diagnosis")
    hidden = record(believed(spring={"stiffness": 0.3, "rest": 0.1}), seconds=4.0)
    model = type(believed()).model_validate(BELIEVED | {"axis": "linear"})
    found = diagnose(model, [linear(made) for made in hidden], time_limit_s=90.0)
    return folder, write_files(folder, found, "model.yaml")


def test_document_has_the_keys_of_the_contract(written: tuple[Path, dict[str, Any]]) -> None:
    folder, document = written
    assert json.loads((folder / "diagnosis.json").read_text()) == document
    assert set(document) >= TOP
    assert [finding["effect"] for finding in document["findings"]] == ["spring"]
    assert "spring" not in document["minor"]
    finding = document["findings"][0]
    assert set(finding) >= FINDING
    located = finding["located"]
    assert set(located["recordings"]) == {"run0.csv", "run1.csv", "run2.csv"}
    assert {w["recording"] for w in located["time_windows"]} <= set(located["recordings"])
    assert {"position", "velocity", "direction", "frequency", "load", "acceleration"} <= set(located)
    assert finding["held_out"]["after"] < 0.3 * finding["held_out"]["before"]
    assert {row["noise_floor"] > 0.0 for row in document["recordings"]} == {True}
    assert load_axis_model(folder / "model.yaml").spring is not None


def test_a_linear_axis_has_metres_and_newtons(written: tuple[Path, dict[str, Any]]) -> None:
    folder, document = written
    told = json.dumps(document, ensure_ascii=False)
    assert not re.search(r"N·m|\brad\b(?!_s)|kg·m²", told)
    assert document["findings"][0]["parameters"]["stiffness"]["unit"] == "N/m"
    assert document["findings"][0]["located"]["position"]["unit"] == "m"
    page = (folder / "report.html").read_text()
    assert "kg·m²" not in page.split("<body>")[1]


def test_what_is_told_of_the_mismatch_is_that_of_unseen_rows(written: tuple[Path, dict[str, Any]]) -> None:
    """Of each recording, of all of them, and the shares in sentences: one and the same numbers."""
    document = written[1]
    fit, rows = document["fit"], np.array([recording["rows"] for recording in document["recordings"]])
    for side in ("before", "after"):
        each = np.array([recording[f"mismatch_{side}"] for recording in document["recordings"]])
        assert np.sqrt(rows @ each**2 / rows.sum()) == pytest.approx(fit["held_out"][side], rel=1e-9)
    before, after, floor = (v**2 for v in (fit["held_out"]["before"], fit["held_out"]["after"], fit["noise_floor"]))
    assert fit["explainable_removed"] == pytest.approx((before - after) / (before - floor), abs=1e-4)
    assert f"{100.0 * fit['explainable_removed']:.0f} % of the explainable mismatch is gone" in document["summary"]
    assert f"carries {100.0 * fit['explainable_removed']:.0f} %" in document["findings"][0]["statement"]
    assert fit["held_out"]["left_out"] in (written[0] / "report.html").read_text()


def test_windows_stray_less_with_what_was_found(written: tuple[Path, dict[str, Any]]) -> None:
    for window in written[1]["fit"]["windows"].values():
        assert set(window["recordings"]) == {"run0.csv", "run1.csv", "run2.csv"}
        assert window["after"] < 0.5 * window["before"]
        assert window["unit"] == "m"


def test_page_stands_alone(written: tuple[Path, dict[str, Any]]) -> None:
    folder, document = written
    page = (folder / "report.html").read_text()
    body = page.split("<body>")[1]
    assert not re.search(r'<(script|link|img)[^>]+(src|href)="?http', page)
    order = (
        'id="verdict"',
        "Where the model is off",
        "Finding 1: spring",
        "95 % interval",
        "The fit before and after",
        "What remains",
        "Which experiment next",
        "The recordings",
        "How it was found",
        "Time by stage",
    )
    places = [body.index(part) for part in order]
    assert places == sorted(places)
    assert body.index(document["findings"][0]["statement"][:40]) < body.index("Where the model is off")
    pictures = {path.name for path in (folder / "pictures").iterdir()}
    assert {"where.png", "finding_spring_1.png", "held_out.png", "over_time.png", "maps.png", "spectrum.png",
            "windows.png"} <= pictures  # fmt: skip


def test_data_that_cannot_tell_get_a_page_and_no_model(tmp_path: Path) -> None:
    (tmp_path / "model.yaml").write_text("stale")
    made = record(believed())[0]
    still = {q: v.copy() for q, v in made.columns.items()}
    still[Quantity.POSITION] = np.zeros(len(made))
    document = write_files(
        tmp_path, diagnose(believed(), [Recording(made.path, made.axis, still, made.measured, ())]), "model.yaml"
    )
    assert document["verdict"] == "cannot_tell"
    assert document["findings"] == []
    assert not (tmp_path / "model.yaml").exists()
    page = (tmp_path / "report.html").read_text()
    assert "These data cannot tell" in page
    assert "too still" in page
    assert "Let the axis move" in page


def test_command_ends_with_no_when_nothing_can_be_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = record(believed())[1]
    most = 0.2 * float(np.median(np.abs(made.torque)))
    short, cut = recording(made.t_s[:900], made.torque[:900], made.position[:900]), np.clip(made.torque, -most, most)
    for name, bad in {"short": short, "saturated": recording(made.t_s, cut, made.position)}.items():
        write_csv(bad, tmp_path / f"{name}.csv")
    (tmp_path / "model.yaml").write_text(axis_model_yaml(believed()))
    files = [str(tmp_path / f"{name}.csv") for name in ("short", "saturated")]
    out = tmp_path / "out"
    assert run(["diagnose", "--model", str(tmp_path / "model.yaml"), *files, "--out", str(out), "--json"]) == 1
    told = capsys.readouterr()
    document = json.loads(told.out)
    assert document["verdict"] == "cannot_tell"
    reasons = {row["name"]: row["reason"] for row in document["recordings"]}
    assert "too short" in reasons["short.csv"]
    assert "saturated" in reasons["saturated.csv"]
    assert "These data cannot tell" in told.err
    assert (out / "report.html").exists()
    assert not (out / "model.yaml").exists()


def test_every_look_can_be_said() -> None:
    for effect in effects():
        key = effect.look.coordinate.replace(" ", "_")
        located = {"recordings": {"a.csv": 1.0}, "time_windows": [], key: {"from": 0.0, "to": 1.0, "unit": "rad"}}
        located["time_windows"] = [{"recording": "a.csv", "start_s": 1.0, "end_s": 2.0}]
        assert describe_place(effect.name, located).endswith("in a.csv from 1.00 to 2.00 s")


def test_maps_tell_a_curve_from_a_constant() -> None:
    made = record(believed(), seconds=4.0)
    traces, _ = load_traces(made, believed())
    predictor = Predictor(traces, believed())
    rng = np.random.default_rng(1)
    noise = 0.01 * rng.normal(size=len(predictor.counts))
    constant = {m.coordinate: m for m in maps(predictor, noise + 0.05)}
    assert constant["everywhere alike"].share > 0.9
    assert max(m.share for name, m in constant.items() if name != "everywhere alike") < 0.05
    curve = np.where(predictor.counts, 0.1 * predictor.over("position"), 0.0)
    ordered = maps(predictor, noise + curve)
    assert ordered[0].coordinate == "position"
    assert ordered[0].share > 0.7


@pytest.mark.parametrize(
    ("before", "after", "says", "not_said"),
    [
        (0.0105, 0.0100, "Both are within the noise: the difference says nothing.", "gone"),
        (0.0200, 0.0210, "did not become less: 0.02 before, 0.021 N·m after", "gone"),
        (0.0500, 0.0102, "96 % of what could be explained is gone, and what is left is within the noise.", "nothing"),
        (0.0500, 0.0300, "went from 0.05 to 0.03 N·m; the noise floor is 0.01 N·m. 96 % of what", "within"),
    ],
)
def test_a_change_within_the_noise_is_no_gain(before: float, after: float, says: str, not_said: str) -> None:
    held = {"before": before, "after": after, "left_out": "a.csv"}
    fit = {"unit": "N·m", "held_out": held, "noise_floor": 0.01, "explainable_removed": 0.96}
    said = describe_fit({"fit": fit})
    assert says in said and not_said not in said
