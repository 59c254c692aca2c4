"""Replay: a model replays its own motion to the noise; windows, delays, gaps, start states and the command itself."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from servod.axis_model import AxisModel
from servod.cli.app import run
from servod.models.motion import smoothed_motion
from servod.models.plant import Plant
from servod.models.replay import Drive, replay, window_starts
from tests.physics.models import joint


def recorded(model: AxisModel, seconds: float = 3.0, step: float = 2.0 * np.pi / 2**20) -> Drive:
    """A PD-controlled motion of `model`, as a recorder sees it: quantised position, held command."""
    axis = Plant(model, 5)
    t = np.arange(0.0, seconds, 1e-3)
    torque, position = np.zeros(len(t)), np.zeros(len(t))
    last = 0.0
    for k, now in enumerate(t):
        position[k] = round(axis.encoder_position_rad / step) * step
        goal = 0.2 * np.sin(2.0 * np.pi * 0.5 * now) + 0.05 * np.sin(2.0 * np.pi * 2.3 * now)
        torque[k] = 2.5 * (goal - position[k]) - 0.05 * (position[k] - last) / 1e-3
        last = position[k]
        axis.advance(torque[k], 1e-3)
    return Drive(t, torque, position, np.full(len(t), np.nan))


OWN: dict[str, dict[str, Any]] = {
    "plain": {},
    "delay": {"delay_s": 0.0137},
    "lag": {"actuator_lag": {"time_constant_s": 0.02}},
    "gravity": {"gravity": {"amplitude": 0.05, "phase": 0.3}},
    "cogging": {"cogging": {"harmonics": [{"amplitude": 0.01, "periods_per_turn": 17}]}},
    "elastic": {"joint_elasticity": {"load_inertia": 0.0005, "stiffness": 5.0, "damping": 0.002}},
}


@pytest.mark.parametrize("case", OWN)
def test_a_model_replays_its_own_motion(case: str) -> None:
    """With the physics that made the motion, windows of 50 ms end within a few counts' worth of start error."""
    model = joint(**{"delay_s": 0.001, **OWN[case]})
    drive = recorded(model)
    assert replay(model, drive, 0.05).rms < 1.2e-4
    if case != "plain":
        assert replay(joint(delay_s=0.001), drive, 0.05).rms > 3.0 * replay(model, drive, 0.05).rms


def test_short_windows_hold_the_start_state() -> None:
    """Every window starts on the recorded position, moving as the recording moves."""
    drive = recorded(joint(delay_s=0.001))
    result = replay(joint(inertia=0.002, delay_s=0.001), drive, 0.1)
    assert len(result.starts) == 30
    assert np.max(np.abs(result.error[result.starts])) < 2e-5
    assert np.allclose(result.velocity[result.starts[1:]], drive.motion[result.starts[1:], 1])
    assert result.velocity[0] == 0.0  # it stood still when the recording began


def test_a_free_run_starts_once_and_a_long_gap_starts_anew() -> None:
    t = np.concatenate([np.arange(0.0, 1.0, 1e-3), np.arange(2.0, 3.0, 1e-3)])
    assert window_starts(t, None).tolist() == [0, 1000]
    assert window_starts(np.arange(0.0, 1.0, 1e-3), None).tolist() == [0]
    assert window_starts(np.arange(0.0, 1.0, 1e-3), 0.25).tolist() == [0, 250, 500, 750]


def test_smoothing_follows_smooth_motion_and_impacts() -> None:
    """A quantised sine gives its velocity to a part in a hundred; a jump of velocity is not smeared over the span."""
    t = np.arange(0.0, 2.0, 1e-3)
    step = 2.0 * np.pi / 2**20
    sine = np.round(np.sin(3.0 * t) / step) * step
    assert np.max(np.abs(smoothed_motion(t, sine)[20:-20, 1] - 3.0 * np.cos(3.0 * t)[20:-20])) < 0.01
    kink = np.round(np.abs(t - 1.0) / step) * step
    velocity = smoothed_motion(t, kink)[:, 1]
    assert velocity[990] == pytest.approx(-1.0, abs=0.02)
    assert velocity[1010] == pytest.approx(1.0, abs=0.02)


def written(folder: Path, rows_dropped: int = 0) -> tuple[Path, Path]:
    """The plain joint's model file, and a recording of it as CSV."""
    model = folder / "model.yaml"
    friction = (
        "{kind: lugre, sigma0: 950, sigma1: 1, viscous: 0.056, coulomb: 0.045, static: 0.07, stribeck_velocity: 0.1}"
    )
    model.write_text(f"inertia: 1e-3\nfriction: {friction}\n")
    drive = recorded(joint(delay_s=0.001), 1.0)
    lines = [f"{t:.6f},{u:.9g},{x:.9g}" for t, u, x in zip(drive.t_s, drive.torque, drive.position, strict=True)]
    path = folder / "run.csv"
    path.write_text("\n".join(["t_s,torque_nm,position_rad", *lines[: 500 - rows_dropped], *lines[500:]]) + "\n")
    return model, path


def test_command_writes_one_row_for_each_recorded_row(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model, path = written(tmp_path, rows_dropped=7)
    out = tmp_path / "sim.csv"
    assert run(["replay", "--model", str(model), str(path), "--horizon", "0.25", "--out", str(out), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["rms_error_rad"] < document["max_error_rad"] < 0.01
    assert document["rows"] == 993 and "7 samples missing" in document["report"][0]
    simulated = np.genfromtxt(out, delimiter=",", names=True)
    assert simulated.dtype.names == ("t_s", "position_rad", "velocity_rad_s")
    assert np.array_equal(simulated["t_s"], np.genfromtxt(path, delimiter=",", names=True)["t_s"])


@pytest.mark.parametrize(
    "arguments, word",
    [
        (["--horizon", "soon"], "--horizon"),
        (["--horizon", "-1"], "--horizon"),
        (["--horizon", "nan"], "--horizon"),
        (["--out", "sim.xlsx"], ".csv or .parquet"),
        (["--out", "/no/such/folder/sim.csv"], "no such folder"),
        (["--map", "none.yaml"], "none.yaml"),
    ],
)
def test_command_names_mistakes(
    arguments: list[str], word: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model, path = written(tmp_path)
    assert run(["replay", "--model", str(model), str(path), *arguments]) == 2
    assert word in capsys.readouterr().err


def test_command_refuses_a_linear_model_for_a_rotary_recording(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model, path = written(tmp_path)
    model.write_text("axis: linear\n" + model.read_text())
    assert run(["replay", "--model", str(model), str(path)]) == 2
    assert "axis" in capsys.readouterr().err
