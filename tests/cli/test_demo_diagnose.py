"""`servoctl demo --diagnose` as its user sees it: the effect is found in the axis's own recording and cured."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from servod.cli.app import run


@pytest.mark.timeout(600)
def test_what_a_concealed_effect_cost_comes_back(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["demo", "--diagnose", "--fast", "--out", str(tmp_path), "--json"]) == 0
    captured = capsys.readouterr()
    document = json.loads(captured.out)
    assert captured.err == ""
    rms = document["rms_error_mrad"]
    assert document["concealed"] == "gravity"
    assert [finding["effect"] for finding in document["findings"]] == ["gravity"]
    assert rms["concealed"] > 1.5 * rms["before"]
    assert document["recovered_share"] >= 0.8
    assert document["deployment"]["deployed"]
    assert (tmp_path / "report.html").stat().st_size > 1_000_000
    assert (tmp_path / "diagnosis" / "report.html").exists()
    assert {path.name for path in (tmp_path / "recordings").iterdir()} == {
        "paper.mcap",
        "slow_sine.mcap",
        "multisine.mcap",
        "moves.mcap",
    }


def test_conceal_needs_diagnose_and_a_known_effect(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["demo", "--fast", "--conceal", "gravity", "--out", str(tmp_path)]) == 2
    assert "only with --diagnose" in capsys.readouterr().err
    assert run(["demo", "--diagnose", "--fast", "--conceal", "backlash", "--out", str(tmp_path)]) == 2
    assert "--conceal" in capsys.readouterr().err
