"""Which way round the keys of the configuration are: from the file's number to what the cycle reads and sends."""

from __future__ import annotations

import math
import struct
from typing import Any

import pytest

from servod.cli.config import config_keys
from servod.drivers.cia402 import Cia402Amplifier
from servod.drivers.cia402_setup import AmplifierSetup
from servod.drivers.cia406 import Cia406Encoder, EncoderSetup
from servod.formats.config import AxisConfig
from servod.runtime.fieldbus.devices import AmplifierCommand, Goal

MEANING = {key.key: key.meaning for key in config_keys()}
LIMITS = {
    **{"torque_nm": 1e3, "torque_rate_nm_per_s": 1e3, "speed_rad_s": 1.0, "position_min_rad": -1.0},
    **{"position_max_rad": 1.0, "following_error_rad": 0.1, "encoder_mismatch_rad": 0.1},
}
RATED_NM, TURN = 2.0, 4000
#: Operation enabled, 0x6041.
ENABLED = 0x0637


def config(**sections: dict[str, Any]) -> AxisConfig:
    return AxisConfig.model_validate({"limits": LIMITS, "gains": {"initial": "gains.yaml"}, **sections})


def amplifier(**keys: Any) -> Cia402Amplifier:
    """The driver of a motor with TURN counts a turn and RATED_NM before its gear."""
    plan = AmplifierSetup(
        config(amplifier={"counts_per_turn": TURN, "rated_torque_mnm": 1000 * RATED_NM, **keys})
    ).plan()
    return Cia402Amplifier(plan)


def told(driver: Cia402Amplifier, counts: int, per_mille: int = 0) -> Cia402Amplifier:
    """The driver after the drive said its position (0x6064) and torque (0x6077)."""
    driver.on_frame(driver.receive_ids[1], struct.pack("<bH", 10, 0), 0)
    driver.on_frame(driver.receive_ids[0], struct.pack("<Hih", ENABLED, counts, per_mille), 0)
    return driver


def target_of(driver: Cia402Amplifier, torque_nm: float) -> int:
    """What goes to 0x6071 for a torque at the joint."""
    _, data = driver.write(AmplifierCommand(Goal.ENABLED, torque_nm=torque_nm))
    return int(struct.unpack("<Hh", data)[1])


def test_a_gear_ratio_of_100_is_a_reducer() -> None:
    assert "100 for a 100:1 reducer" in MEANING["amplifier.gear_ratio"]
    feedback = told(amplifier(gear_ratio=100.0), counts=100 * TURN, per_mille=500).read()
    assert feedback.position_rad == pytest.approx(2.0 * math.pi)
    assert feedback.torque_nm == pytest.approx(100.0 * 0.5 * RATED_NM)
    assert target_of(told(amplifier(gear_ratio=100.0), 0), 0.5 * 100.0 * RATED_NM) == 500


def test_counts_and_rated_torque_of_the_drive_are_before_the_gear() -> None:
    for key, words in (("counts_per_turn", "motor shaft, before the gear"), ("rated_torque_mnm", "before the gear")):
        assert words in MEANING[f"amplifier.{key}"]
    feedback = told(amplifier(gear_ratio=10.0), counts=TURN, per_mille=1000).read()
    assert feedback.position_rad == pytest.approx(2.0 * math.pi / 10.0)
    assert feedback.torque_nm == pytest.approx(10.0 * RATED_NM)


def test_directions_of_the_drive_turn_its_position_and_both_torques() -> None:
    assert told(amplifier(position_direction=-1), counts=TURN).read().position_rad == pytest.approx(-2.0 * math.pi)
    turned = told(amplifier(torque_direction=-1), counts=TURN, per_mille=100)
    assert turned.read().torque_nm == pytest.approx(-0.1 * RATED_NM)
    assert turned.read().position_rad == pytest.approx(2.0 * math.pi)
    assert target_of(turned, 0.1 * RATED_NM) == -100


@pytest.mark.parametrize("direction", [1, -1])
def test_the_joint_is_at_zero_where_the_encoder_reads_the_zero_offset(direction: int) -> None:
    assert "what the encoder reads, with direction, where the joint is to be at 0" in MEANING["encoder.zero_offset_rad"]
    plan = EncoderSetup(
        config(encoder={"counts_per_turn": TURN, "direction": direction, "zero_offset_rad": direction * 0.5 * math.pi})
    ).plan()
    plan.facts["measuring_range_counts"] = 2**32
    encoder = Cia406Encoder(plan)
    encoder.on_frame(encoder.receive_ids[0], struct.pack("<I", TURN // 4), 0)
    assert encoder.read().position_rad == pytest.approx(0.0, abs=1e-9)
    encoder.on_frame(encoder.receive_ids[0], struct.pack("<I", TURN // 2), 1_000_000)
    assert encoder.read().position_rad == pytest.approx(direction * 0.5 * math.pi)
