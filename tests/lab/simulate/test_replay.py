"""Replay: a model replays its own motion to the noise; windows, delays, gaps, start states and the command itself."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from servod.cli.app import run
from servod.common.yaml import parse_yaml
from servod.formats.model.axis_model import AxisModel
from servod.kernels.physics.effects import encoder_position
from servod.kernels.physics.layout import PlantState
from servod.kernels.physics.plant import Plant
from servod.lab.simulate.motion import Start, beginning, smoothed_motion
from servod.lab.simulate.open_loop import recorded_motion
from servod.lab.simulate.replay import Drive, replay, window_starts
from tests.kernels.physics.models import joint
from tests.lab.simulate.slide import SLIDE, set_off


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


def cut(drive: Drive, first: int, last: int | None = None) -> Drive:
    """Some rows of a recording, as one that began later."""
    rows = slice(first, last)
    return Drive(drive.t_s[rows], drive.torque[rows], drive.position[rows], drive.temperature_c[rows])


EFFECTS: dict[str, dict[str, Any]] = parse_yaml((Path(__file__).parent / "effects.yaml").read_text(), "effects.yaml")

#: Groups that hold the physics that an effect needs to show; the model without the effect has them too.
BESIDE = {"backlash": "gravity", "joint_elasticity": "gravity"}


@pytest.mark.parametrize("effect", EFFECTS)
def test_a_model_replays_its_own_motion(effect: str) -> None:
    """Recorded from mid-motion (0.9 rad/s, one count is 6 urad) the model that made the motion comes out far ahead.

    What is left is the start: one-sided slopes, and for two masses a ringing that the motor shows only later.
    """
    keys = EFFECTS[effect]
    drive = cut(recorded(joint(**{"delay_s": 0.001, **keys})), 700)
    without = joint(delay_s=0.001, **{key: keys[key] for key in keys if key == BESIDE.get(effect)})
    for horizon_s, most, lead in ((0.05, 8e-5, 3.5), (None, 3e-4, 30.0)):
        own = replay(joint(**{"delay_s": 0.001, **keys}), drive, horizon_s).rms
        assert own < most
        assert replay(without, drive, horizon_s).rms > lead * own


def test_an_eccentric_encoder_is_looked_through() -> None:
    """Position, velocity and acceleration behind the encoder: the inverse of what the plant shows."""
    packed = joint(**EFFECTS["encoder_eccentricity"]).pack()
    t = np.linspace(0.0, 1.0, 2001)
    true = np.column_stack([np.sin(3.0 * t), 3.0 * np.cos(3.0 * t), -9.0 * np.sin(3.0 * t)])
    shown = np.array([encoder_position(*packed, x) for x in true[:, 0]])
    rate = np.gradient(shown, t, edge_order=2)
    motion = np.column_stack([shown, rate, np.gradient(rate, t, edge_order=2)])
    recorded_motion(*packed, PlantState(), motion)
    assert np.allclose(motion[5:-5], true[5:-5], atol=1e-3)
    assert np.allclose(motion[:, 0], true[:, 0], atol=1e-12)


def test_a_load_hangs_on_its_spring_when_the_recording_begins() -> None:
    """A pendulum behind a soft spring with a gap: at the first row the spring holds it, on the side it pulls to."""
    groups = {
        "joint_elasticity": {"load_inertia": 0.0004, "stiffness": 5.0, "damping": 0.05, "cubic": 300.0},
        "backlash": {"gap": 0.02},
        "gravity": {"amplitude": 0.06},
    }
    axis = Plant(joint(**groups), 1)
    axis.place(1.0)
    for _ in range(4000):
        axis.advance(0.02, 1e-3)
    sagged = axis.motor_position_rad - axis.position_rad
    rows = np.full(300, axis.encoder_position_rad)
    drive = Drive(np.arange(300) * 1e-3, np.full(300, 0.02), rows, np.full(300, np.nan))
    result = replay(joint(**groups), drive, None)
    assert sagged > 0.015
    assert result.position - result.load_position == pytest.approx(np.full(300, sagged), abs=2e-5)


def test_a_recording_cut_out_of_a_motion_keeps_its_small_speed() -> None:
    """Just behind a reversal the speed is 1 to 7 % of the RMS speed, and it is not rest."""
    model = joint(delay_s=0.001)
    drive = recorded(model)
    speed = drive.motion[:, 1]
    share = speed / np.sqrt(np.mean(speed**2))
    first = 500 + int(np.argmax((share[500:-1] < 0.066) & (share[501:] >= 0.066))) + 1
    result = replay(model, cut(drive, first), None)
    assert not result.at_rest
    assert result.velocity[0] == pytest.approx(speed[first], rel=0.1)
    assert result.rms < 2e-4


@pytest.mark.parametrize("horizon_s", [0.05, 0.5, None])
def test_the_first_row_is_rest_or_as_recorded(horizon_s: float | None) -> None:
    """By wish, and by evidence: the recorder missed the first 7 ms of a motion from rest, which a window must not."""
    drive = set_off(missed=7)
    model = AxisModel.model_validate(SLIDE)
    assert replay(model, drive, horizon_s).at_rest == (horizon_s is None)
    assert replay(model, set_off(missed=0), horizon_s).at_rest
    assert replay(model, drive, horizon_s, start=Start.REST).at_rest
    as_recorded = replay(model, drive, horizon_s, start=Start.RECORDED)
    assert as_recorded.velocity[0] == pytest.approx(drive.motion[0, 1]) and as_recorded.velocity[0] > 3e-3
    assert not replay(model, set_off(missed=40), horizon_s).at_rest


def test_a_free_run_of_a_linear_slide_is_exact() -> None:
    """An integrator that shares nothing with the kernels, two seconds without feedback: metres, newtons, kilograms."""
    drive = set_off(missed=0)
    assert np.ptp(drive.position) > 0.05
    model = AxisModel.model_validate(SLIDE)
    assert replay(model, drive, None).rms < 5e-6
    late = AxisModel.model_validate({**SLIDE, "delay_s": 0.001})
    assert replay(late, drive, None).rms > 1e-5


def test_the_command_before_the_first_row() -> None:
    """New to an axis that stands and leaves at once; the first row's own where the axis stayed under it or moves."""
    t = np.arange(200) * 1e-3
    moved = np.where(t > 0.003, 10.0 * np.clip(t - 0.003, 0.0, None) ** 2, 0.0)

    def before(torque: NDArray[np.float64], position: NDArray[np.float64]) -> float:
        return beginning(Start.AUTO, t, torque, position, smoothed_motion(t, position)).under(0.0).command_before

    assert before(np.full(200, 0.2), moved) == 0.0
    assert before(0.1 + 10.0 * t, moved) == 0.1
    assert before(np.full(200, 0.05), np.zeros(200)) == 0.05
    assert before(np.full(200, 0.05), 0.3 * t) == pytest.approx(0.05)


def test_joint_starts_at_its_ambient_temperature_without_a_recorded_one() -> None:
    model = joint(delay_s=0.001, thermal={"dry_per_c": -0.01, "ambient_c": 45.0})
    told = joint(delay_s=0.001, thermal={"dry_per_c": -0.01, "ambient_c": 20.0}, noise={"temperature_c": 45.0})
    assert (model.start_temperature_c, told.start_temperature_c, joint().start_temperature_c) == (45.0, 45.0, 25.0)
    assert replay(model, recorded(model, 1.5), None).rms < 1e-4


def test_drift_counts_from_the_first_row() -> None:
    """Stamps since 1970 give the same motion as stamps since the start."""
    model = joint(delay_s=0.001, thermal={"dry_per_s": -0.2})
    drive = recorded(model, 1.5)
    late = Drive(drive.t_s + 1.7e9, drive.torque, drive.position, drive.temperature_c)
    assert replay(model, late, None).rms == pytest.approx(replay(model, drive, None).rms, abs=1e-5)
    assert replay(model, late, None).rms < 1e-4


def test_short_windows_hold_the_start_state() -> None:
    """Every window starts on the recorded position, moving as the recording moves."""
    drive = recorded(joint(delay_s=0.001))
    result = replay(joint(inertia=0.002, delay_s=0.001), drive, 0.1)
    assert len(result.starts) == 30
    assert np.max(np.abs(result.error[result.starts])) < 2e-5
    assert np.allclose(result.velocity[result.starts[1:]], drive.motion[result.starts[1:], 1])
    assert result.velocity[0] == 0.0  # it stood still when the recording began


def test_a_free_run_starts_once_and_windows_start_anew_behind_a_long_gap() -> None:
    t = np.concatenate([np.arange(0.0, 1.0, 1e-3), np.arange(2.0, 3.0, 1e-3)])
    assert window_starts(t, None).tolist() == [0]
    assert window_starts(t, 5.0).tolist() == [0, 1000]
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


@pytest.mark.parametrize("horizon, did", [("full", "run through"), ("0.25", "restarted")])
def test_command_says_what_it_did_at_gaps_and_at_the_start(
    horizon: str, did: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model, path = written(tmp_path, rows_dropped=30)
    assert run(["replay", "--model", str(model), str(path), "--horizon", horizon, "--start", "rest", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["start"] == "rest"
    assert document["windows"] == (1 if horizon == "full" else 4)
    assert did in document["report"][-1]


@pytest.mark.parametrize(
    "arguments, word",
    [
        (["--horizon", "soon"], "--horizon"),
        (["--horizon", "-1"], "--horizon"),
        (["--horizon", "nan"], "--horizon"),
        (["--start", "moving"], "auto, rest, recorded"),
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
