"""Diagnosis of recordings that have a goal and a position only: what makes torque of them is fitted and told."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from servod.common.errors import BadInput
from servod.formats.model.axis_model import AxisModel
from servod.lab.diagnose.data.intake import load_traces
from servod.lab.diagnose.document import diagnosis_document
from servod.lab.diagnose.engine import diagnose
from servod.lab.diagnose.judge.verdict import product_with
from servod.lab.diagnose.predict.predict import Predictor
from servod.lab.diagnose.result import Diagnosis
from servod.lab.recordings import Recording
from tests.lab.simulate.servo_axis import ServoAxis, goal_of
from tests.lab.simulate.test_servo import PERIOD_S, model_of, recorded, write

TRUTH = ServoAxis(gain=6.0, full=3.0, delay_s=0.03, coulomb=0.06, gravity=0.8)


def recordings(axis: ServoAxis, tmp_path: Path) -> list[Recording]:
    """Three motions."""
    found = []
    for kind in range(3):
        (tmp_path / str(kind)).mkdir()
        found.append(recorded(axis, tmp_path / str(kind), kind))
    return found


def document_of(axis: ServoAxis, runs: Sequence[Recording], **drive: Any) -> tuple[Diagnosis, dict[str, Any]]:
    """The diagnosis of a model of that truth without its delay, and with keys of its drive changed."""
    found = diagnose(model_of(axis, delay_s=0.0, **drive), runs, 60.0)
    return found, diagnosis_document(found)


def test_delay_and_torque_of_a_servo_are_found_from_goals_and_positions(tmp_path: Path) -> None:
    found, document = document_of(TRUTH, recordings(TRUTH, tmp_path), torque_per_command=None)
    (finding,) = document["findings"]
    assert finding["effect"] == "delay"
    low, high = finding["parameters"]["additional_s"]["interval"]
    assert low < TRUTH.delay_s < high and high - low < 0.01
    torque = document["drive"]["torque_per_command"]
    assert torque["interval"][0] < TRUTH.full < torque["interval"][1]
    assert found.evidence is not None
    window = document["fit"]["windows"]["1"]
    assert window["after"] < 0.3 * window["before"]
    drive = found.evidence.model.drive
    assert drive is not None and drive.torque_per_command == pytest.approx(torque["value"])


@pytest.mark.parametrize(
    ("hidden", "believed", "effect", "key", "value"),
    [
        ({"goal_rate": 2.6}, {}, "goal_rate", "goal_rate", 2.6),
        ({"goal_rate": 0.8}, {}, "goal_rate", "goal_rate", 0.8),
        ({"dead_band": 0.06}, {}, "drive_dead_band", "dead_band", 0.06),
        ({"ki": 5.0}, {}, "drive_integral", "ki", 5.0),
        ({"ki": 2.0}, {}, "drive_integral", "ki", 2.0),
        ({}, {"gain_scale": 0.5}, "drive_gain", "gain_scale", 1.0),
    ],
)
def test_what_a_servo_does_beside_its_gain_is_named(
    hidden: dict[str, float], believed: dict[str, float], effect: str, key: str, value: float, tmp_path: Path
) -> None:
    axis = replace(TRUTH, **hidden)
    found = diagnosis_document(diagnose(model_of(axis, **believed), moved(axis, tmp_path), 120.0))
    names = [finding["effect"] for finding in found["findings"]]
    assert names == [effect]
    assert found["findings"][0]["parameters"][key]["value"] == pytest.approx(value, rel=0.15)


@pytest.mark.parametrize(
    ("hidden", "effects"),
    [
        ({}, []),
        ({"goal_rate": 2.6}, ["goal_rate"]),
        ({"per_torque": 0.3}, ["load_dependent_friction"]),
        # Both at once are told apart or not by the last digits of a solver: load friction goes into a torque 19 % low.
    ],
)
def test_the_torque_of_a_servo_is_found_where_its_goal_jumps(
    hidden: dict[str, float], effects: list[str], tmp_path: Path
) -> None:
    """A limited rate and friction of the load look like a weak drive; both stand in the fit of the torque."""
    axis = replace(TRUTH, **hidden)
    found = diagnosis_document(diagnose(model_of(axis, torque_per_command=None), moved(axis, tmp_path), 120.0))
    assert found["drive"]["torque_per_command"]["value"] == pytest.approx(TRUTH.full, rel=0.03)
    assert [finding["effect"] for finding in found["findings"]] == effects


def test_of_gain_and_torque_only_the_product_shows_below_the_limit(tmp_path: Path) -> None:
    """A name for either would be as right as one for the other."""
    model = model_of(TRUTH)
    predictor = Predictor(load_traces(moved(TRUTH, tmp_path), model)[0], model)
    assert product_with(predictor, model, "drive_gain") == product_with(predictor, model, "delay") == ""
    free = model_of(TRUTH, limit=50.0)
    assert product_with(predictor, free, "drive_gain") == "torque_gain"
    assert product_with(predictor, free, "torque_gain") == "drive_gain"


def test_a_gain_that_is_not_told_from_the_torque_is_no_certain_name(tmp_path: Path) -> None:
    runs = moved(TRUTH, tmp_path, 0.12)
    document = diagnosis_document(diagnose(model_of(TRUTH, gain_scale=0.5), runs, 60.0))
    (finding,) = (one for one in document["findings"] if one["effect"] in {"drive_gain", "torque_gain"})
    assert finding["confidence"] <= 0.5
    assert "only the product of" in finding["statement"]
    assert {finding["effect"], finding["alternatives"][0]["effect"]} == {"drive_gain", "torque_gain"}


def moved(axis: ServoAxis, tmp_path: Path, size: float = 1.0) -> list[Recording]:
    """Steps with rests, whose goal jumps, and two sines."""
    t_s = np.arange(600) * PERIOD_S
    jumps = np.array([0.0, 0.9, -0.5, 0.3, -0.9, 1.2, 0.0])[np.minimum(t_s / 0.9, 6.0).astype(int)]
    found = []
    for name, goal in (("jumps", size * jumps), ("sines", size * goal_of(t_s, 0))):
        path = tmp_path / f"{name}.csv"
        found.append(write(path, t_s=t_s, reference_rad=goal, position_rad=axis.run(goal, PERIOD_S)))
    return found


def test_back_emf_is_told_from_friction_where_the_drive_goes_off(tmp_path: Path) -> None:
    axis = replace(TRUTH, viscous=0.1, emf=0.5, off_from_s=3.5)
    t_s = np.arange(600) * PERIOD_S
    runs = []
    for kind, goal in enumerate((np.interp(t_s, [0.0, 3.0], [0.0, 2.4]), goal_of(t_s, 0))):
        columns = {"t_s": t_s, "reference_rad": goal, "position_rad": axis.run(goal, PERIOD_S)}
        runs.append(write(tmp_path / f"{kind}.csv", **columns, enabled=(t_s < 3.5).astype(float)))
    model = model_of(replace(axis, viscous=0.6))  # what one measures who does not know of it
    found = diagnosis_document(diagnose(model, runs, 120.0))
    low, high = found["drive"]["emf_viscous"]["interval"]
    assert low < 0.5 < high and high - low < 0.3
    assert not found["findings"]


def test_an_unknown_gain_of_a_servo_is_told_with_its_interval(tmp_path: Path) -> None:
    _, document = document_of(TRUTH, recordings(TRUTH, tmp_path), kp=None)
    low, high = document["drive"]["kp"]["interval"]
    assert low < TRUTH.gain < high < 1.3 * low


def test_nothing_is_named_of_a_drive_that_is_known(tmp_path: Path) -> None:
    found = diagnose(model_of(TRUTH), recordings(TRUTH, tmp_path), 60.0)
    assert found.evidence is not None
    assert not found.evidence.findings and not found.evidence.drive


def test_of_gain_and_torque_one_must_be_known(tmp_path: Path) -> None:
    model = model_of(TRUTH, kp=None, torque_per_command=None)
    with pytest.raises(BadInput, match="only their product"):
        diagnose(model, recordings(TRUTH, tmp_path), 10.0)


def test_rows_in_which_the_drive_is_off_do_not_count(tmp_path: Path) -> None:
    t_s = np.arange(600) * PERIOD_S
    axis = ServoAxis(off_from_s=4.0)
    goal = goal_of(t_s, 0)
    enabled = (t_s < 4.0).astype(float)
    run = write(
        tmp_path / "off.csv", t_s=t_s, reference_rad=goal, position_rad=axis.run(goal, PERIOD_S), enabled=enabled
    )
    model: AxisModel = model_of(axis)
    found = diagnosis_document(diagnose(model, [run], 30.0))
    (told,) = found["recordings"]
    assert any(note.startswith("drive: off in 33 %") for note in told["notes"])
    assert not found["findings"]
