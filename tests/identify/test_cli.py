"""`servoctl identify` by its exit codes and its document; what it finds is scored in test_walk."""

from __future__ import annotations

import json

import pytest

from servod.axis_model import load_axis_model
from servod.cli.app import run
from servod.shipped import shipped
from tests.identify.conftest import Identification

pytestmark = pytest.mark.timeout(600)  # a whole identification is part of the first test that needs it


def test_recordings_become_a_model_and_a_document(fine: Identification, tmp_path, capsys):
    out = tmp_path / "model.yaml"
    command = ["identify", "--recordings", str(fine.recordings), "--out", str(out), "--json"]
    assert run(command) == 0
    found = json.loads(capsys.readouterr().out)
    inertia = found["identified"]["inertia"]
    assert inertia["low"] < inertia["value"] < inertia["high"]
    assert load_axis_model(out).identified.values["inertia"].value == inertia["value"]
    assert run([*command, "--before", str(out)]) == 0
    assert json.loads(capsys.readouterr().out)["changes"] == []


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ([], "--config"),
        (["--recordings", "nowhere"], "nowhere"),
        (["--plant", "nowhere.yaml"], "nowhere.yaml"),
        (["--before", str(shipped("gains/axes/table1_joint.yaml"))], "identified"),
    ],
)
def test_bad_input_is_one_line(options, said, tmp_path, capsys):
    assert run(["identify", "--out", str(tmp_path / "model.yaml"), *options]) == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1
    assert said in captured.err
    assert not (tmp_path / "model.yaml").exists()
