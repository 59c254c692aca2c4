"""`servoctl commission` and `servoctl deploy` by their exit codes and their one line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from servod.cli.app import run
from servod.common.shipped import shipped
from servod.formats.model.axis_model import axis_model_yaml, load_axis_model
from tests.lab.identify.joints import draw

JOINT = shipped("gains/axes/table1_joint.yaml")


@pytest.mark.parametrize(
    ("options", "code", "said"),
    [
        ([], 2, "--config"),
        (["--plant", "nowhere.yaml"], 2, "nowhere.yaml"),
        (["--plant", str(JOINT), "--settings", str(JOINT)], 2, "unknown key"),
    ],
)
def test_bad_input_is_one_line(
    options: list[str], code: int, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["commission", "--out", str(tmp_path / "out"), *options]) == code
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1 and said in captured.err


def test_wrong_polarity_stops_the_walk_before_the_joint_moves_far(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plant, wrong, out = tmp_path / "plant.yaml", tmp_path / "devices.yaml", tmp_path / "out"
    plant.write_text(axis_model_yaml(draw(4).model))
    wrong.write_text("rated_torque_mnm: 100\npolarity: 0x20\n")
    assert run(["commission", "--plant", str(plant), "--settings", str(wrong), "--out", str(out), "--json"]) == 1
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1 and "direction" in captured.err
    failed = json.loads(captured.out)["failed"]
    assert failed["step"] == "identify" and "direction" in failed["message"]
    assert json.loads((out / "state.json").read_text())["steps"] == {}
    assert not (out / "model.yaml").exists()


def test_a_folder_of_another_plant_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, plant = tmp_path / "out", tmp_path / "plant.yaml"
    out.mkdir()
    (out / "state.json").write_text('{"axis": {"plant": "another one"}, "steps": {}}\n')
    plant.write_text(axis_model_yaml(load_axis_model(JOINT)))
    assert run(["commission", "--plant", str(plant), "--out", str(out)]) == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1 and "another" in captured.err


def test_a_real_axis_is_not_moved_without_a_person(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = tmp_path / "axis.yaml"
    limits = (
        "{torque_nm: 1, torque_rate_nm_per_s: 100, speed_rad_s: 1, position_min_rad: -1, position_max_rad: 1, "
        "following_error_rad: 0.1, encoder_mismatch_rad: 0.1}"
    )
    config.write_text(f"limits: {limits}\ngains: {{initial: pd.yaml}}\n")
    command = ["commission", "--config", str(config), "--socket", str(tmp_path / "none"), "--out", str(tmp_path / "o")]
    assert run(command) == 2
    assert "--yes" in capsys.readouterr().err
    assert run([*command, "--yes"]) == 3
    assert "no daemon answers" in capsys.readouterr().err


def test_deploy_refuses_a_set_without_a_certificate(capsys: pytest.CaptureFixture[str]) -> None:
    gains = shipped("gains/demo_pd.yaml")
    assert run(["deploy", str(gains), "--plant", str(JOINT)]) == 2
    assert "certificate" in capsys.readouterr().err
    assert run(["deploy", str(gains), "--present", str(gains)]) == 2
    assert "--plant" in capsys.readouterr().err
