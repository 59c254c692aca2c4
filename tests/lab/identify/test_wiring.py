"""An axis wired with a wrong sign or scale is found by the first motion, which is small, and told by its key."""

from __future__ import annotations

import json

import numpy as np
import pytest

from servod.cli.app import run
from servod.client.stepped import SteppedAxis
from servod.client.virtual import rated_torque_mnm, virtual_config, virtual_session
from servod.common.errors import AnswerIsNo, BadInput
from servod.drivers.virtual.settings import VirtualAxisSettings
from servod.formats.model.axis_model import AxisKind, axis_model_yaml
from servod.formats.model.effects import TorqueGain
from servod.lab.identify.walk import identify
from servod.runtime.loop.axis_state import AxisState
from tests.lab.identify.joints import draw

JOINT = draw(4).model
RATED_MNM = rated_torque_mnm(JOINT)
MOST_TRAVEL_RAD = np.radians(2.0)


def refused(folder, plant, config, settings) -> str:
    """What identification says of this axis, which must be off afterwards and not have moved far."""
    session = virtual_session(plant, folder, None, 1, config, settings)
    with pytest.raises(AnswerIsNo) as error:
        identify(SteppedAxis(session, folder), folder / "recordings", lambda _what, _share: None)
    assert session.cycle.axis.state != AxisState.ENABLED
    session.run(0.2)
    assert abs(session.world.truth().position_rad) < MOST_TRAVEL_RAD
    assert abs(session.world.truth().velocity_rad_s) < 2e-3  # torque noise rocks it on its bristles
    assert session.latest.torque_nm == 0.0
    return str(error.value)


@pytest.mark.parametrize(
    ("section", "change", "said"),
    [
        ("amplifier", {"torque_direction": -1}, "amplifier.torque_direction"),
        ("encoder", {"direction": -1}, "encoder.direction"),
        ("amplifier", {"position_direction": -1}, "amplifier.position_direction"),
        ("amplifier", {"counts_per_turn": 2**17}, "the amplifier's sensor moved 8"),
        ("amplifier", {"gear_ratio": 2.0}, "encoder's sensor moved 2 times as far as the amplifier's"),
        ("amplifier", {"gear_ratio": 0.5}, "amplifier's sensor moved 2 times as far as the encoder's"),
        ("amplifier", {"counts_per_turn": 2**26}, "64 times as far"),
    ],
)
def test_a_wrong_configuration_is_told_by_its_key(section, change, said, tmp_path):
    config = virtual_config(tmp_path, RATED_MNM, 2**20)
    wrong = config.model_copy(update={section: getattr(config, section).model_copy(update=change)})
    assert said in refused(tmp_path, JOINT, wrong, None)


@pytest.mark.parametrize(
    ("wiring", "said"),
    [
        ({"polarity": 0x20}, "amplifier.torque_direction"),
        ({"polarity": 0x80}, "amplifier.position_direction"),
        ({"encoder_direction": -1}, "encoder.direction"),
    ],
)
def test_devices_wired_the_wrong_way_are_told(wiring, said, tmp_path):
    settings = VirtualAxisSettings(rated_torque_mnm=RATED_MNM, **wiring)
    assert said in refused(tmp_path, JOINT, None, settings)


@pytest.mark.parametrize(("factor", "said"), [(10.0, "moves at"), (100.0, "moves at"), (0.1, "did not move")])
def test_a_wrong_scale_of_the_torque_is_told(factor, said, tmp_path):
    plant = JOINT.model_copy(update={"torque_gain": TorqueGain(factor=factor)})
    message = refused(tmp_path, plant, None, None)
    assert said in message
    assert "scale of the torque" in message


def test_what_the_devices_know_themselves_is_refused_before_any_motion(tmp_path):
    with pytest.raises(BadInput, match="counts_per_turn"):
        virtual_session(JOINT, tmp_path, 2**17, 1, virtual_config(tmp_path, RATED_MNM, 2**20))
    config = virtual_config(tmp_path, RATED_MNM, 2**20)
    wrong = config.model_copy(update={"amplifier": config.amplifier.model_copy(update={"rated_torque_mnm": 1000})})
    with pytest.raises(BadInput, match="rated_torque_mnm"):
        virtual_session(JOINT, tmp_path, None, 1, wrong)


def test_the_command_ends_with_one_line_and_exit_code_1(tmp_path, capsys):
    (tmp_path / "plant.yaml").write_text(axis_model_yaml(JOINT))
    (tmp_path / "wired.yaml").write_text(f"{{rated_torque_mnm: {RATED_MNM}, polarity: 32}}\n")
    options = ["--plant", str(tmp_path / "plant.yaml"), "--settings", str(tmp_path / "wired.yaml")]
    assert run(["identify", "--out", str(tmp_path / "model.yaml"), *options, "--json"]) == 1
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1
    assert "wrong polarity" in captured.err
    assert json.loads(captured.out)["error"]["exit_code"] == 1


def test_a_linear_axis_is_bad_input(tmp_path, capsys):
    linear = JOINT.model_copy(update={"axis": AxisKind.LINEAR, "cogging": None})
    (tmp_path / "slide.yaml").write_text(axis_model_yaml(linear))
    options = ["--out", str(tmp_path / "model.yaml"), "--plant", str(tmp_path / "slide.yaml")]
    assert run(["identify", *options]) == 2
    assert "slide.yaml: axis: found linear" in capsys.readouterr().err
