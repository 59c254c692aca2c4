"""Hashes in a synthesized set: the model's file, the recordings behind it, the tool; `servoctl verify` shows them."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import pytest

from servod.cli.app import run
from servod.common.sources import SYNTHESIZES, source_sha256
from servod.formats.gains.gain_set import load_gains
from servod.formats.model.axis_model import axis_model_yaml
from servod.formats.model.identified import Identified, IdentifiedMap
from tests.lab.synthesize.designs import table1

RECORDINGS = ["ab" * 32, "cd" * 32]


def test_the_set_carries_the_hashes_and_verify_shows_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    curve = IdentifiedMap(velocities=[-0.1, 0.1], torques=[-0.05, 0.05], half_widths=[0.001, 0.001])
    measured = Identified(values={}, friction_map=curve, data_sha256=RECORDINGS)
    model, out = tmp_path / "model.yaml", tmp_path / "gains.yaml"
    model.write_text(axis_model_yaml(table1().model_copy(update={"identified": measured})))
    assert run(["synthesize", "--model", str(model), "--out", str(out), "--mode", "reference", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)["hashes"]
    origin = load_gains(out).provenance
    assert origin.model_sha256 == told["model_sha256"] == hashlib.sha256(model.read_bytes()).hexdigest()
    assert origin.data_sha256 == told["data_sha256"] == RECORDINGS
    assert origin.tool_sha256 == told["tool_sha256"] == source_sha256(SYNTHESIZES) and "servod" in origin.tool
    assert run(["verify", str(out), "--json", "--plants", "1"]) == 1
    shown = json.loads(capsys.readouterr().out)["hashes"]
    assert shown == {
        "parameters": load_gains(out).parameters_sha256(),
        "model": origin.model_sha256,
        "data": RECORDINGS,
        "tool": origin.tool_sha256,
    }
