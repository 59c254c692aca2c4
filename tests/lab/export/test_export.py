"""An exported axis moves in MuJoCo as it does here, and what is left out is named with its cost."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from servod.cli.app import run
from servod.formats.model.axis_model import AxisModel, axis_model_yaml
from servod.lab.export import mjcf, urdf
from servod.lab.export.export import AGREES, costs, export, own_motion, round_trip
from servod.lab.export.reduce import folded, losses
from servod.lab.simulate.replay import replay

DRY = {"kind": "coulomb_viscous", "viscous": 0.3, "coulomb": 0.8}
LUGRE = {"kind": "lugre", "sigma0": 2000.0, "sigma1": 2.0, "viscous": 0.3, "coulomb": 0.8, "static": 1.1}
WAVES = [{"amplitude": 0.2, "periods_per_turn": 12.0, "phase": 1.0}, {"amplitude": 0.1, "periods_per_turn": 24.0}]


def joint(**keys: Any) -> AxisModel:
    """A joint of 0.05 kg*m^2 with a delay of 3 ms."""
    return AxisModel.model_validate({"inertia": 0.05, "delay_s": 0.003, "friction": DRY} | keys)


SAID_BY_MJCF = {
    "dry friction": joint(),
    "bristles and Stribeck curve": joint(friction=LUGRE | {"stribeck_velocity": 0.05}),
    "weight": joint(gravity={"amplitude": 2.0, "phase": 0.7}),
    "weight that is told the other way round": joint(gravity={"amplitude": -2.0, "phase": 0.7}),
    "spring": joint(spring={"stiffness": 3.0, "rest": 0.3, "cubic": 2.0}),
    "cogging": joint(friction=LUGRE, cogging={"harmonics": WAVES}),
    "lag": joint(actuator_lag={"time_constant_s": 0.02}),
    "gain, limit, offset": joint(
        torque_gain={"factor": 0.8}, torque_offset=0.2, torque_saturation={"limit": 1.5, "negative_limit": 1.2}
    ),
    "viscous curve": joint(viscous_nonlinear={"quadratic": 0.2, "cubic": 0.1}),
    "elastic": joint(
        joint_elasticity={"load_inertia": 0.03, "stiffness": 60.0, "damping": 0.05, "load_viscous": 0.1},
        gravity={"amplitude": 1.0},
    ),
    "slide": joint(axis="linear", inertia=95.0, friction=DRY | {"viscous": 203.0, "coulomb": 20.0}),
}


@pytest.mark.parametrize("name", SAID_BY_MJCF)
def test_mjcf_moves_as_the_model_and_leaves_nothing_out(name: str) -> None:
    model = SAID_BY_MJCF[name]
    assert not list(losses(model, mjcf.LOSSES))
    found = round_trip(mjcf.says(model), mjcf.write(mjcf.says(model), "axis"), "axis", [own_motion(model)])
    assert found.engine.startswith("MuJoCo") and found.agrees and found.apart < AGREES


LEFT_OUT = {
    "friction.stribeck": joint(friction={"kind": "stribeck", "coulomb": 0.8, "static": 1.0, "stribeck_velocity": 0.1}),
    "load_dependent_friction": joint(gravity={"amplitude": 2.0}, load_dependent_friction={"per_load": 0.3}),
    "asymmetry": joint(asymmetry={"positive_dry": 1.3}),
    "torque_ripple": joint(torque_ripple={"harmonics": [{"amplitude": 0.2, "periods_per_turn": 6.0}]}),
    "friction.local": joint(
        friction={
            "kind": "local", "sigma0": 2000.0, "sigma1": 2.0, "viscous": 0.3,
            "velocities": [-1.0, -0.1, -0.01, 0.01, 0.1, 1.0], "torques": [-1.4, -0.9, -1.2, 1.0, 0.7, 1.2],
        }
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", LEFT_OUT)
def test_what_mjcf_leaves_out_is_named_and_costs_what_the_file_is_off(name: str) -> None:
    model, said = LEFT_OUT[name], mjcf.says(LEFT_OUT[name])
    drives = [own_motion(model)]
    lost = costs(model, mjcf.LOSSES, drives)
    found = round_trip(said, mjcf.write(said, "axis"), "axis", drives)
    assert list(lost) == [name] and lost[name] > 1e-3
    assert found.agrees and found.theirs == pytest.approx(lost[name], rel=0.1)


def test_urdf_keeps_inertia_weight_friction_and_limit_alone() -> None:
    model = joint(
        friction=LUGRE, gravity={"amplitude": 2.0}, torque_saturation={"limit": 2.5}, cogging={"harmonics": WAVES}
    )
    said = urdf.says(model)
    drives = [own_motion(model)]
    lost = set(costs(model, urdf.LOSSES, drives))
    assert lost == {"cogging", "friction.stribeck", "friction.bristle", "delay_s"}
    root = ET.fromstring(urdf.write(said, "elbow"))
    dynamics = root.find("joint[@name='elbow']/dynamics")
    assert dynamics is not None and dynamics.attrib == {"damping": "0.3", "friction": "0.8"}
    assert round_trip(said, urdf.write(said, "elbow"), "elbow", drives).agrees


def test_a_file_that_says_something_else_does_not_agree() -> None:
    model = joint()
    wrong = mjcf.write(joint(inertia=0.055), "axis")
    assert not round_trip(mjcf.says(model), wrong, "axis", [own_motion(model)]).agrees


@pytest.mark.parametrize(
    "model",
    [
        joint(stribeck={"static": 1.1, "stribeck_velocity": 0.05}, presliding={"sigma0": 2000.0, "sigma1": 2.0}),
        joint(presliding={"sigma0": 2000.0}),
        joint(stribeck={"static": 1.1, "stribeck_velocity": 0.05}),
        joint(friction=LUGRE, presliding={"sigma1": 5.0}),
    ],
)
def test_groups_of_friction_folded_into_the_law_are_the_same_physics(model: AxisModel) -> None:
    drive = own_motion(model)
    plain = folded(model)
    assert plain.stribeck is None and plain.presliding is None
    np.testing.assert_array_equal(replay(plain, drive, 0.25).position, replay(model, drive, 0.25).position)


def test_json_is_the_whole_model(tmp_path: Path) -> None:
    model = LEFT_OUT["asymmetry"]
    done = export(model, "json", tmp_path / "axis.json", "axis", [])
    assert AxisModel.model_validate(json.loads((tmp_path / "axis.json").read_text())["axis_model"]) == model
    assert done.not_expressed == {} and done.round_trip is not None and done.round_trip.apart == 0.0


def test_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "model.yaml").write_text(axis_model_yaml(LEFT_OUT["asymmetry"]))
    out = tmp_path / "axis.xml"
    words = ["export", "--model", str(tmp_path / "model.yaml"), "--out", str(out)]
    assert run([*words, "--format", "mujoco", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["round_trip"]["agrees"] and set(document["not_expressed"]) == {"asymmetry"}
    assert ET.parse(out).getroot().tag == "mujoco"
    assert run([*words, "--format", "urdf"]) == 0
    said = capsys.readouterr().out
    assert "round trip: agrees" in said and "not expressed: asymmetry, which costs" in said
    for wrong in (["--format", "sdf"], ["--joint", "a b"], ["--out", str(tmp_path / "no" / "axis.xml")]):
        assert run([*words, *wrong]) == 2
        assert capsys.readouterr().err.count("\n") == 1
    before = (tmp_path / "model.yaml").read_bytes()
    for wrong in (["--out", str(tmp_path / "model.yaml")], ["--map", "kscale"]):
        assert run([*words, *wrong]) == 2
        assert capsys.readouterr().err.count("\n") == 1
    assert (tmp_path / "model.yaml").read_bytes() == before


def test_without_the_engine_the_file_is_written_and_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    (tmp_path / "model.yaml").write_text(axis_model_yaml(joint()))
    out = tmp_path / "axis.xml"
    assert run(["export", "--model", str(tmp_path / "model.yaml"), "--out", str(out)]) == 0
    assert "servod[sim]" in capsys.readouterr().out and out.stat().st_size > 0
