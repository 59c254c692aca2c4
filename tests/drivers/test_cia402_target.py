"""What each mode of operation puts into the target of the RPDO, to the last count, and the set-point's handshake."""

from __future__ import annotations

import math
from typing import Any

import pytest

from servod.common.errors import BadInput
from servod.drivers.cia402_target import (
    CyclicTarget,
    PositionTarget,
    ProfilePositionTarget,
    TorqueTarget,
    VelocityTarget,
    target_type,
)
from servod.runtime.fieldbus.cia import Obj402
from servod.runtime.fieldbus.devices import AmplifierCommand, Goal, Mode

INT16, INT32 = 2**15, 2**31
FACTS = {
    "rated_torque_nm": 2.0,
    "gear_ratio": 4.0,
    "counts_per_turn": 1 << 16,
    "position_direction": 1,
    "torque_direction": 1,
}
COUNTS_PER_RAD = 4.0 * (1 << 16) / (2 * math.pi)
PER_MILLE_PER_NM = 1000.0 / 8.0
ACKNOWLEDGED, NEW, OFFERED = 0x1237, 0x30, 0x20
ALL = {
    Mode.CYCLIC_SYNC_TORQUE: (TorqueTarget, 0x6071, 16),
    Mode.CYCLIC_SYNC_VELOCITY: (VelocityTarget, 0x60FF, 32),
    Mode.CYCLIC_SYNC_POSITION: (PositionTarget, 0x607A, 32),
    Mode.PROFILE_POSITION: (ProfilePositionTarget, 0x607A, 32),
}


def live(mode: Mode, value: float, **facts: Any) -> int | None:
    """Counts of a torque in cst, of a set-point in the other modes."""
    command = AmplifierCommand(Goal.ENABLED, value, setpoint=7.0)
    if mode != Mode.CYCLIC_SYNC_TORQUE:
        command = AmplifierCommand(Goal.ENABLED, 7.0, setpoint=value)
    return target_type(mode)(FACTS | facts).live(command)


@pytest.mark.parametrize("mode", list(Mode))
def test_each_mode_has_its_object_and_no_other_mode_has_one(mode: Mode) -> None:
    if mode in ALL:
        kind = target_type(mode)
        assert (kind, int(kind.index), kind.bits) == ALL[mode]
        assert isinstance(kind.index, Obj402)
    else:
        with pytest.raises(BadInput, match=f"{mode.name}.*CYCLIC_SYNC_TORQUE, CYCLIC_SYNC_VELOCITY"):
            target_type(mode)


@pytest.mark.parametrize("direction", [1, -1])
def test_torque_is_in_thousandths_of_the_motors_and_stops_at_sixteen_bits(direction: int) -> None:
    top = INT16 - 1
    for per_mille in (0, 1, 999, 1000, top - 1, top, top + 1, 10 * INT16):
        for sign in (1, -1):
            torque_nm = sign * per_mille / PER_MILLE_PER_NM
            counts = live(Mode.CYCLIC_SYNC_TORQUE, torque_nm, torque_direction=direction, position_direction=-1)
            assert counts == direction * sign * min(per_mille, top)
    assert live(Mode.CYCLIC_SYNC_TORQUE, 1.6 / PER_MILLE_PER_NM) == 2, "to the nearest"


@pytest.mark.parametrize("direction", [1, -1])
def test_velocity_is_in_counts_of_the_motor_and_stops_at_thirty_two_bits(direction: int) -> None:
    top = INT32 - 1
    for rate in (0, 1, 65_535, top - 1, top, top + 1, 2 * INT32):
        for sign in (1, -1):
            setpoint = sign * rate / COUNTS_PER_RAD
            counts = live(Mode.CYCLIC_SYNC_VELOCITY, setpoint, position_direction=direction, torque_direction=-1)
            assert counts == direction * sign * min(rate, top)


@pytest.mark.parametrize("mode", [Mode.CYCLIC_SYNC_POSITION, Mode.PROFILE_POSITION])
@pytest.mark.parametrize(
    ("counts", "wire"),
    [
        (0, 0),
        (1, 1),
        (-1, -1),
        (65_537, 65_537),
        (INT32 - 1, INT32 - 1),
        (INT32, -INT32),
        (-INT32, -INT32),
        (-INT32 - 1, INT32 - 1),
        (2 * INT32 + 5, 5),
        (-2 * INT32 - 5, -5),
    ],
)
def test_position_wraps_as_the_drives_counter_does(mode: Mode, counts: int, wire: int) -> None:
    assert live(mode, counts / COUNTS_PER_RAD, torque_direction=-1) == wire
    assert live(mode, -counts / COUNTS_PER_RAD, position_direction=-1) == wire


@pytest.mark.parametrize("mode", list(ALL))
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e308, -1e308])
def test_number_that_is_none_or_overflows_gives_no_target(mode: Mode, value: float) -> None:
    assert live(mode, value) is None


@pytest.mark.parametrize("holding", [False, True])
def test_what_is_sent_while_nothing_may_act_makes_no_jump(holding: bool) -> None:
    sent = {mode: target_type(mode)(FACTS).idle(-4321, 77, holding) for mode in ALL}
    assert sent == {
        Mode.CYCLIC_SYNC_TORQUE: 77 if holding else 0,
        Mode.CYCLIC_SYNC_VELOCITY: 0,
        Mode.CYCLIC_SYNC_POSITION: -4321,
        Mode.PROFILE_POSITION: -4321,
    }


@pytest.mark.parametrize("status_word", [0x0237, ACKNOWLEDGED])
def test_cyclic_modes_need_no_bit_of_the_control_word(status_word: int) -> None:
    assert CyclicTarget().control_bits(5, status_word) == 0


# --- profile position: CiA 402-2, set-point handshake -----------------------------------------------------------------
def bits(target: ProfilePositionTarget, *cycles: tuple[int, int]) -> list[int]:
    """Bits of the control word over cycles of (target, status word)."""
    return [target.control_bits(counts, status_word) for counts, status_word in cycles]


def test_set_point_is_handed_over_once_and_each_new_one_again() -> None:
    target, waiting = ProfilePositionTarget(FACTS), 0x0237
    assert bits(target, (5, waiting), (5, waiting), (5, ACKNOWLEDGED)) == [NEW, NEW, OFFERED]
    assert bits(target, (5, ACKNOWLEDGED), (5, waiting), (5, waiting)) == [OFFERED] * 3
    assert bits(target, (6, waiting), (6, ACKNOWLEDGED), (6, waiting)) == [NEW, OFFERED, OFFERED]


def test_set_point_that_changes_before_the_acknowledge_is_not_lost() -> None:
    target, waiting = ProfilePositionTarget(FACTS), 0x0237
    assert bits(target, (5, waiting), (6, ACKNOWLEDGED), (6, waiting)) == [NEW, OFFERED, NEW], "the drive has taken 5"
    target = ProfilePositionTarget(FACTS)
    assert bits(target, (5, waiting), (6, waiting), (6, ACKNOWLEDGED), (6, waiting)) == [NEW, NEW, OFFERED, NEW]


def test_acknowledge_of_an_earlier_set_point_takes_none() -> None:
    target = ProfilePositionTarget(FACTS)
    assert bits(target, (5, ACKNOWLEDGED), (5, 0x0237), (5, ACKNOWLEDGED)) == [OFFERED, NEW, OFFERED]


@pytest.mark.parametrize("last", [0x0237, ACKNOWLEDGED])
def test_drive_that_was_switched_off_gets_its_set_point_anew(last: int) -> None:
    target = ProfilePositionTarget(FACTS)
    bits(target, (5, 0x0237), (5, last))
    target.idle(4, 0, holding=False)
    assert bits(target, (5, 0x0237), (5, ACKNOWLEDGED), (5, 0x0237)) == [NEW, OFFERED, OFFERED]
