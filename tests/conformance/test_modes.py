"""The other modes of the CiA 402 driver: csv, csp and pp decode and encode in SI units, and enter without a jump."""

from __future__ import annotations

import math
from typing import Any

import pytest
from drivers_under_test import COUNTS_PER_TURN, axis_config, decode, encode, find_pdo

from servod.common.errors import BadInput
from servod.drivers.cia402 import Cia402Amplifier
from servod.drivers.cia402_setup import AmplifierSetup
from servod.runtime.fieldbus.cia import Obj402
from servod.runtime.fieldbus.devices import AmplifierCommand, DriveState, Goal, Mode

STATUS = {DriveState.OPERATION_ENABLED: 0x0237, DriveState.SWITCHED_ON: 0x0233}


class Axis:
    def __init__(self, mode: Mode, **amplifier: Any) -> None:
        self.plan = AmplifierSetup(axis_config(amplifier=amplifier), mode).plan()
        self.driver = Cia402Amplifier(self.plan)
        self.feedback = find_pdo(self.plan, Obj402.STATUS_WORD)
        self.command = find_pdo(self.plan, Obj402.CONTROL_WORD)

    def cycle(self, state: DriveState, setpoint: float, position: int = 0, flags: int = 0) -> tuple[int, int]:
        values = {Obj402.STATUS_WORD: STATUS[state] | flags, Obj402.POSITION_ACTUAL: position}
        self.driver.on_frame(self.feedback.cob_id, encode(self.feedback, values), 0)
        _, data = self.driver.write(AmplifierCommand(Goal.ENABLED, 0.0, setpoint=setpoint))
        target = self.command.entries[1].index
        return decode(self.command, data, Obj402.CONTROL_WORD), decode(self.command, data, target)


@pytest.mark.parametrize(
    ("mode", "target", "bits"),
    [
        (Mode.CYCLIC_SYNC_TORQUE, Obj402.TARGET_TORQUE, 16),
        (Mode.CYCLIC_SYNC_VELOCITY, Obj402.TARGET_VELOCITY, 32),
        (Mode.CYCLIC_SYNC_POSITION, Obj402.TARGET_POSITION, 32),
        (Mode.PROFILE_POSITION, Obj402.TARGET_POSITION, 32),
    ],
)
def test_each_mode_maps_its_target(mode: Mode, target: int, bits: int) -> None:
    entry = Axis(mode).command.entries[1]
    assert (entry.index, entry.bits) == (target, bits)


def test_csp_sends_the_present_position_until_enabled_then_the_set_point() -> None:
    axis = Axis(Mode.CYCLIC_SYNC_POSITION, gear_ratio=2.0, position_direction=-1)
    assert axis.cycle(DriveState.SWITCHED_ON, 1.0, position=4321)[1] == 4321
    counts = axis.cycle(DriveState.OPERATION_ENABLED, math.pi / 2, position=4321)[1]
    assert counts == -COUNTS_PER_TURN * 2 // 4


def test_csp_wraps_with_the_drives_counter() -> None:
    axis = Axis(Mode.CYCLIC_SYNC_POSITION)
    turns = 3000.0  # 3e9 counts do not fit into 32 bits
    counts = axis.cycle(DriveState.OPERATION_ENABLED, turns * 2 * math.pi)[1]
    assert counts == 3_000_000_000 - 2**32


def test_csv_stands_still_until_enabled_then_follows() -> None:
    axis = Axis(Mode.CYCLIC_SYNC_VELOCITY)
    assert axis.cycle(DriveState.SWITCHED_ON, 5.0)[1] == 0
    assert axis.cycle(DriveState.OPERATION_ENABLED, 2 * math.pi)[1] == COUNTS_PER_TURN


@pytest.mark.parametrize("mode", [Mode.CYCLIC_SYNC_VELOCITY, Mode.CYCLIC_SYNC_POSITION])
@pytest.mark.parametrize("setpoint", [math.nan, math.inf])
def test_a_set_point_that_is_not_finite_disables(mode: Mode, setpoint: float) -> None:
    word, target = Axis(mode).cycle(DriveState.OPERATION_ENABLED, setpoint, position=77)
    assert word == 0
    assert target == (77 if mode is Mode.CYCLIC_SYNC_POSITION else 0)


def test_pp_hands_over_each_new_target_once() -> None:
    axis, new, acknowledged = Axis(Mode.PROFILE_POSITION), 1 << 4, 0x1000
    assert axis.cycle(DriveState.OPERATION_ENABLED, 1.0)[0] & new
    assert not axis.cycle(DriveState.OPERATION_ENABLED, 1.0, flags=acknowledged)[0] & new
    assert not axis.cycle(DriveState.OPERATION_ENABLED, 1.0)[0] & new
    assert axis.cycle(DriveState.OPERATION_ENABLED, 2.0)[0] & new


def test_a_mode_that_the_driver_cannot_run_is_refused() -> None:
    with pytest.raises(BadInput, match="HOMING"):
        AmplifierSetup(axis_config(), Mode.HOMING).plan()
