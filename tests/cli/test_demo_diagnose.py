"""`servoctl demo --diagnose`: what it refuses, before anything is started."""

from __future__ import annotations

from pathlib import Path

import pytest

from servod.cli.app import run


def test_conceal_needs_diagnose_and_a_known_effect(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["demo", "--fast", "--conceal", "gravity", "--out", str(tmp_path)]) == 2
    assert "only with --diagnose" in capsys.readouterr().err
    assert run(["demo", "--diagnose", "--fast", "--conceal", "backlash", "--out", str(tmp_path)]) == 2
    assert "--conceal" in capsys.readouterr().err
