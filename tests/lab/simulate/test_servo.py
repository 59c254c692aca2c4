"""Recordings of a goal and a position: replay through the drive of the model, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from servod.common.errors import BadInput
from servod.formats.model.axis_model import AxisModel, axis_model_yaml, load_axis_model
from servod.formats.model.friction import LoadDependentFriction
from servod.lab.recordings import Recording, load_recording
from servod.lab.simulate.replay import driven, replay, switched_on
from tests.lab.simulate.servo_axis import ServoAxis, goal_of

PERIOD_S = 0.01
T = np.arange(600) * PERIOD_S


def write(path: Path, **columns: Any) -> Recording:
    """A recording of these columns."""
    np.savetxt(path, np.column_stack(list(columns.values())), delimiter=",", header=",".join(columns), comments="")
    return load_recording(path)


def model_of(axis: ServoAxis, **changed: Any) -> AxisModel:
    """The axis model of that truth, its drive with keys changed."""
    drive = {"kind": "position_servo", "kp": axis.gain, "torque_per_command": axis.full, "delay_s": axis.delay_s}
    friction = {"kind": "coulomb_viscous", "viscous": axis.viscous, "coulomb": axis.coulomb}
    document = {"inertia": axis.inertia, "delay_s": 0.0, "friction": friction, "gravity": {"amplitude": axis.gravity}}
    return AxisModel.model_validate({**document, "drive": {**drive, **changed}})


def recorded(axis: ServoAxis, tmp_path: Path, kind: int = 0) -> Recording:
    """A goal and the position that the axis makes of it."""
    goal = goal_of(T, kind)
    return write(tmp_path / "run.csv", t_s=T, reference_rad=goal, position_rad=axis.run(goal, PERIOD_S))


@pytest.mark.parametrize("kind", [0, 1, 2])
def test_a_goal_and_a_position_are_replayed_with_the_loop_closed(kind: int, tmp_path: Path) -> None:
    axis = ServoAxis()
    rows, model = recorded(axis, tmp_path, kind), model_of(axis)
    assert replay(model, rows.driven_by(model), None).rms < 0.003
    early = model_of(axis, delay_s=0.0)
    assert replay(early, rows.driven_by(early), None).rms > 0.008


def test_the_torque_over_the_recorded_motion_moves_the_model_alike(tmp_path: Path) -> None:
    axis = ServoAxis()
    model = model_of(axis)
    packed, drive = driven(model, recorded(axis, tmp_path).driven_by(model))
    assert packed.p.delay_s == 0.0
    assert replay(packed, drive, 0.25).rms < 0.006


def test_gain_damping_and_supply_come_from_wherever_they_stand(tmp_path: Path) -> None:
    axis = ServoAxis(gain=5.0, kd=0.05)
    goal = goal_of(T, 0)
    columns = {"t_s": T, "reference_rad": goal, "position_rad": axis.run(goal, PERIOD_S)}
    kp, supply = np.full(len(T), 50.0), np.full(len(T), 6.0)
    rows = write(tmp_path / "run.csv", **columns, kp=kp, supply_v=supply)
    drive = {"kp": None, "gain_scale": 0.1, "kd": 0.5, "torque_per_command": 2.0 * axis.full, "supply_v": 12.0}
    model = model_of(axis, **drive)
    assert replay(model, rows.driven_by(model), None).rms < 0.003


def test_a_drive_that_goes_off_is_seen_and_obeyed(tmp_path: Path) -> None:
    axis = ServoAxis(off_from_s=3.0)
    goal = np.interp(T, [0.0, 2.5, 6.0], [0.0, 1.2, 1.2])
    columns = {"t_s": T, "reference_rad": goal, "position_rad": axis.run(goal, PERIOD_S)}
    model = model_of(axis)
    seen = switched_on(model, write(tmp_path / "run.csv", **columns).driven_by(model))
    assert seen.told is not None
    assert abs(T[np.argmin(seen.told.on)] - 3.0) < 0.1 and not seen.told.on[320:].any()
    told = write(tmp_path / "told.csv", **columns, enabled=(T < 3.0).astype(float))
    assert replay(model, told.driven_by(model), None).rms < 0.01


@pytest.mark.parametrize(
    ("hidden", "drive"),
    [
        ({"goal_rate": 2.0}, {"goal_rate": 2.0}),
        ({"dead_band": 0.05}, {"dead_band": 0.05}),
        ({"ki": 4.0}, {"ki": 4.0}),
        ({"emf": 0.6, "per_torque": 0.2}, {"emf_viscous": 0.6}),
    ],
)
def test_what_a_drive_does_beside_its_gain_is_replayed(
    hidden: dict[str, float], drive: dict[str, float], tmp_path: Path
) -> None:
    axis = ServoAxis(**hidden)
    goal = 0.9 * np.sign(np.sin(2.0 * T)) * np.minimum(T, 1.0)
    rows = write(tmp_path / "run.csv", t_s=T, reference_rad=goal, position_rad=axis.run(goal, PERIOD_S))
    plain, model = model_of(axis), model_of(axis, **drive)
    if axis.per_torque:
        model = model.model_copy(update={"load_dependent_friction": LoadDependentFriction(per_command=axis.per_torque)})
    right, wrong = (replay(one, rows.driven_by(one), None).rms for one in (model, plain))
    assert right < 0.01 and wrong > 3.0 * right
    for horizon_s in (0.25, 1.0):  # windows begin with the goal on its way, and the integral as it stands
        assert replay(model, rows.driven_by(model), horizon_s).rms < 0.01
    packed, moved = driven(model, rows.driven_by(model))
    least = 0.04 if axis.dead_band else 0.012  # a row that crosses the edge of a band is known by its mean alone
    assert replay(packed, moved, 0.25).rms < least


def test_some_rows_of_a_recording_know_where_goal_and_integral_stand(tmp_path: Path) -> None:
    axis = ServoAxis(goal_rate=0.8, ki=4.0)
    rows, model = recorded(axis, tmp_path), model_of(axis, goal_rate=0.8, ki=4.0)
    drive = rows.driven_by(model)
    part = drive.part(slice(150, 400)).part(slice(50, None))
    made, whole = driven(model, part)[1].torque, driven(model, drive)[1].torque[200:400]
    assert np.array_equal(made, whole)
    alone = replace(part, whole=None, begun=0)
    assert np.max(np.abs(driven(model, alone)[1].torque - whole)) > 0.2


def test_a_drive_that_follows_its_goal_slowly_is_on(tmp_path: Path) -> None:
    axis = ServoAxis(goal_rate=1.0)
    goal = np.array([0.0, 1.2, -1.2, 1.2])[np.minimum(T / 1.5, 3.0).astype(int)]
    model = model_of(axis)
    rows = write(tmp_path / "run.csv", t_s=T, reference_rad=goal, position_rad=axis.run(goal, PERIOD_S))
    seen = switched_on(model, rows.driven_by(model)).told
    assert seen is not None and seen.on.all()


def test_a_drive_is_off_where_it_reports_no_duty_far_from_its_goal(tmp_path: Path) -> None:
    axis = ServoAxis(off_from_s=3.0, emf=0.5)
    goal = np.interp(T, [0.0, 1.0, 2.5, 6.0], [0.0, 0.0, 1.2, 1.2])
    position = axis.run(goal, PERIOD_S)
    duty = np.where(T < 3.0, np.clip(axis.gain * (goal - position), -1.0, 1.0), 0.0)
    assert np.count_nonzero(duty[:100] == 0.0) > 50  # at its goal it makes none either
    rows = write(tmp_path / "run.csv", t_s=T, reference_rad=goal, position_rad=position, duty=duty)
    model = model_of(axis, emf_viscous=axis.emf)
    told = rows.driven_by(model).told
    assert told is not None and np.array_equal(told.on, T < 3.0)
    assert replay(model, rows.driven_by(model), None).rms < 0.01


def test_shipped_maps_read_whether_the_drive_is_on_where_the_file_says_so(tmp_path: Path) -> None:
    axis, goal = ServoAxis(), np.full(len(T), 0.5)
    columns = {"t_s": T, "reference_rad": goal, "position_rad": axis.run(goal, PERIOD_S)}
    volt = {"voltage_command_v": 7.4 * goal, "supply_v": 7.4 + 0.0 * T}
    model = model_of(axis)
    for more, on in (({"torque_enable": np.where(T < 2.0, 1.0, 0.0)}, T < 2.0), ({}, T >= 0.0)):
        table = {**columns, **volt, **more}
        path = tmp_path / f"run{len(more)}_kp4.csv"
        np.savetxt(path, np.column_stack(list(table.values())), delimiter=",", header=",".join(table), comments="")
        told = load_recording(path, "bam").driven_by(model).told
        assert told is not None and np.array_equal(told.on, on)


def test_a_voltage_through_a_motor(tmp_path: Path) -> None:
    motor = {"kind": "voltage", "k_t": 0.01, "resistance": 2.0, "gear": 100.0, "k_e": 0.01}
    base = {"inertia": 0.03, "delay_s": 0.004, "friction": {"kind": "coulomb_viscous", "viscous": 0.1, "coulomb": 0.05}}
    model = AxisModel.model_validate({**base, "drive": motor})
    volt = 3.0 * np.sin(3.0 * T)
    plain = {**base, "friction": {**base["friction"], "viscous": 0.1 + 0.5}}  # gear^2*k_t*k_e/R
    torque = write(tmp_path / "torque.csv", t_s=T, torque_nm=0.5 * volt, position_rad=1e-3 * np.sin(T))
    expected = replay(AxisModel.model_validate(plain), torque.drive, None).position
    rows = write(tmp_path / "volt.csv", t_s=T, voltage_v=volt, position_rad=1e-3 * np.sin(T))
    found = replay(model, rows.driven_by(model), None).position
    assert np.max(np.abs(found - expected)) < 0.02 * np.ptp(expected)


def test_what_is_missing_is_said_in_one_line(tmp_path: Path) -> None:
    axis = ServoAxis()
    rows = recorded(axis, tmp_path)
    for changed, names in (
        ({"kp": None}, ["column kp", "drive.kp"]),
        ({"kind": "voltage", "kp": None}, ["voltage_v", "reference_rad"]),
        ({"torque_per_command": None}, ["torque_per_command", "diagnose"]),
    ):
        model = model_of(axis, **changed) if changed.get("kind") != "voltage" else volts(axis)
        with pytest.raises(BadInput) as refused:
            rows.driven_by(model)
        assert all(name in str(refused.value) for name in names), refused.value
    without = model_of(axis).model_copy(update={"drive": None})
    with pytest.raises(BadInput, match="drive: in the model"):
        rows.driven_by(without)


def volts(axis: ServoAxis) -> AxisModel:
    """The same axis with a drive of another kind."""
    document = model_of(axis).model_dump(exclude_none=True, exclude_defaults=True, mode="json")
    return AxisModel.model_validate({**document, "drive": {"kind": "voltage", "torque_per_command": 1.0}})


def test_a_drive_is_written_and_read_back(tmp_path: Path) -> None:
    model = model_of(ServoAxis(), ki=0.3, dead_band=0.002, goal_rate=4.0, limit=0.8)
    path = tmp_path / "model.yaml"
    path.write_text(axis_model_yaml(model))
    assert load_axis_model(path) == model
