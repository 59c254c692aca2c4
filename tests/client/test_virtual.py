"""The virtual axis that suits a joint: where it stands when somebody switches it on."""

from __future__ import annotations

import math
from typing import Any

import pytest

from servod.client.virtual import resting_rad, virtual_session
from servod.formats.model.axis_model import AxisModel


def weighted(amplitude_nm: float, **more: Any) -> AxisModel:
    friction = {"kind": "lugre", "sigma0": 760.0, "sigma1": 1.0, "viscous": 0.056, "coulomb": 0.045}
    friction |= {"static": 0.06, "stribeck_velocity": 0.1}
    gravity = {"amplitude": amplitude_nm, "phase": 0.8}
    return AxisModel.model_validate({"inertia": 0.001, "friction": friction, "gravity": gravity} | more)


def test_a_weight_below_friction_is_held_where_it_is():
    assert resting_rad(weighted(0.06)) == 0.0
    assert resting_rad(weighted(0.06, noise={"torque_rms": 0.003, "encoder_rms": 1e-5})) == 0.0


def test_a_weight_above_friction_hangs_at_its_lowest_point():
    assert resting_rad(weighted(0.12)) == pytest.approx(-0.8, abs=1e-4)
    offset = weighted(0.12, torque_offset=-0.03)  # pulls further back
    assert resting_rad(offset) == pytest.approx(-0.8 - math.asin(0.03 / 0.12), abs=1e-3)


def test_a_spring_above_friction_has_pulled_the_joint_to_where_it_rests():
    none = {"amplitude": 0.0, "phase": 0.0}
    assert resting_rad(weighted(0.0, gravity=none, spring={"stiffness": 0.5, "rest": 0.4})) == pytest.approx(
        0.4, abs=1e-3
    )
    assert resting_rad(weighted(0.0, gravity=none, spring={"stiffness": 0.1, "rest": 0.4})) == 0.0


def test_an_axis_with_a_weight_above_friction_can_be_enabled(tmp_path):
    session = virtual_session(weighted(0.12), tmp_path, None, 1)
    session.enable()
    session.run(0.2)
    assert session.cycle.encoder_position_rad == pytest.approx(-0.8, abs=0.02)
