"""A horizon that the recording does not reach restarts nothing, and the command says so."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from servod.cli.app import run


def told(folder: Path, horizon: str, capsys: pytest.CaptureFixture[str]) -> list[str]:
    words = ["replay", str(folder / "run.csv"), "--model", str(folder / "model.yaml"), "--horizon", horizon, "--json"]
    assert run(words) == 0
    report: list[str] = json.loads(capsys.readouterr().out)["report"]
    return [line for line in report if "--horizon" in line]


def test_a_horizon_beyond_the_recording_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "model.yaml").write_text(
        "inertia: 0.001\nfriction: {kind: coulomb_viscous, coulomb: 0.04, viscous: 0.02}\n"
    )
    rows = [f"{0.001 * k:.3f},0.0,{0.1 * math.sin(0.003 * k):.6f}" for k in range(2000)]
    (tmp_path / "run.csv").write_text("\n".join(["t_s,torque_nm,position_rad", *rows]))
    assert told(tmp_path, "2.5", capsys) == ["--horizon: 2.5 s is longer than the 1.999 s of the recording; no restart"]
    assert told(tmp_path, "1.9", capsys) == [] == told(tmp_path, "full", capsys)
