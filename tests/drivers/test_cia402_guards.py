"""The drive's own limits and ways to stop: what is written, what stays, what is refused, object by object."""

from __future__ import annotations

import math
from typing import Any

import pytest

from servod.common.errors import Unreachable
from servod.drivers.cia402_setup import AmplifierSetup, Guards, put_back, write_position_limits
from servod.runtime.fieldbus.cia import Abort
from servod.runtime.fieldbus.devices import SdoAbort
from tests.drivers.test_cia402_setup import ABORT, FAULT_REACTION, QUICK_STOP, Dictionary, axis_config, configured

TORQUES = (0x6072, 0x60E0, 0x60E1)
LIMITS: dict[str, Any] = {
    "torque_nm": 1.0,
    "torque_rate_nm_per_s": 100.0,
    "speed_rad_s": 10.0,
    "position_min_rad": -1.0,
    "position_max_rad": 2.0,
    "following_error_rad": 0.5,
    "encoder_mismatch_rad": 0.25,
}


def set_up(device: Dictionary, **amplifier: Any) -> dict[str, Any]:
    """The facts after `configure`, of a drive of 2 N*m with 4000 counts behind no gear unless stated."""
    amplifier = {"rated_torque_mnm": None, "counts_per_turn": 4000, "gear_ratio": 1.0} | amplifier
    config = axis_config(amplifier=amplifier).model_copy(
        update={"limits": axis_config().limits.model_copy(update=LIMITS)}
    )
    return AmplifierSetup(config).configure(device).facts


class Rounding(Dictionary):
    """A drive that keeps speeds in whole `step`."""

    step = 1

    def write(self, index: int, subindex: int, value: int) -> None:
        super().write(index, subindex, value // self.step * self.step if index == 0x6080 else value)


class Refusing(Dictionary):
    """A drive that has the object and takes nothing for it."""

    refused = 0

    def write(self, index: int, subindex: int, value: int) -> None:
        if index == self.refused:
            raise SdoAbort("refused", Abort.VALUE_RANGE)
        super().write(index, subindex, value)


class Ranged(Dictionary):
    """A drive that refuses a range whose ends are exchanged."""

    def write(self, index: int, subindex: int, value: int) -> None:
        if index == 0x607D:
            ends = {1: self[0x607D, 1], 2: self[0x607D, 2]} | {subindex: value}
            if ends[1] > ends[2]:
                raise SdoAbort("refused", Abort.MAX_BELOW_MIN)
        super().write(index, subindex, value)


def test_the_limits_of_the_configuration_stand_in_the_drive() -> None:
    device = Dictionary()
    facts = set_up(device, gear_ratio=4.0)
    assert [device[index, 0] for index in TORQUES] == [125] * 3  # 1 N*m behind 4:1, per mille of 2 N*m
    assert device[0x6080, 0] == math.ceil(1.1 * 10.0 * 4.0 * 60.0 / math.tau)
    assert device[0x607F, 0] == math.ceil(1.1 * 10.0 * 4.0 * 4000 / math.tau)
    assert (device[0x6065, 0], device[0x6066, 0]) == (math.ceil(0.5 * 4.0 * 4000 / math.tau), 10)
    assert (device[QUICK_STOP], device[FAULT_REACTION], device[0x1029, 1], device[ABORT]) == (2, 2, 0, 3)
    assert facts["most_torque_nm"] == 1.0
    assert {(index, sub): value for index, sub, value in facts["guards"]}.items() <= device.items()


def test_a_speed_in_revolutions_a_minute_is_written_as_such() -> None:
    device = Dictionary()
    device[0x60A9, 0] = 0x00B44700
    set_up(device)
    assert device[0x607F, 0] == device[0x6080, 0] == 106


@pytest.mark.parametrize("index", TORQUES)
def test_a_tighter_limit_is_the_engineers_and_counts(index: int) -> None:
    device = Dictionary()
    device[index, 0] = 300
    facts = set_up(device)
    assert device[index, 0] == 300
    assert facts["most_torque_nm"] == pytest.approx(0.6)  # the least of the three is what the drive gives
    assert f"0x{index:04X}:0 stands at 300, tighter than 500: it stays" in facts["notes"]


def test_a_limit_that_the_drive_rounds_is_taken_and_told() -> None:
    device = Rounding()
    device.step = 7
    facts = set_up(device, gear_ratio=10.0)
    assert device[0x6080, 0] == 1050
    assert (0x6080, 0, 1050) in facts["guards"]
    assert "0x6080:0: the drive rounds 1051 to 1050" in facts["notes"]


def test_a_limit_that_is_kept_otherwise_is_refused() -> None:
    device = Rounding()
    device.step = 100
    with pytest.raises(Unreachable, match="0x6080:0: wrote 1051, device reads 1000"):
        set_up(device, gear_ratio=10.0)


def test_a_limit_that_cannot_be_written_is_told() -> None:
    device = Refusing()
    device.refused = 0x6080
    assert "0x6080:0 stays at 4294967295, not 106: refused, 0x06090030; it guards nothing" in set_up(device)["notes"]


@pytest.mark.parametrize("missing", [QUICK_STOP, FAULT_REACTION])
def test_a_drive_that_cannot_be_told_how_to_stop_is_refused(missing: tuple[int, int]) -> None:
    absent, refusing = Dictionary(), Refusing()
    del absent[missing]
    refusing.refused = missing[0]
    for device in (absent, refusing):
        with pytest.raises(Unreachable, match=f"object 0x{missing[0]:04X} does not take 2"):
            configured(device)
        notes = configured(device, unguarded=True).facts["notes"]
        assert any(f"no 0x{missing[0]:04X}" in note for note in notes)


def test_a_drive_that_refuses_its_reaction_to_a_dead_master_is_refused() -> None:
    device = Refusing()
    device.refused = ABORT[0]
    with pytest.raises(SdoAbort):
        configured(device, unguarded=True)


@pytest.mark.parametrize(("option", "reaction"), [(0, 0), (4, 4), (5, 1), (8, 4)])
def test_after_a_fault_the_drive_stops_as_at_a_quick_stop(option: int, reaction: int) -> None:
    device = Dictionary()
    configured(device, quick_stop_option=option)
    assert device[FAULT_REACTION] == reaction


@pytest.mark.parametrize("direction", [1, -1])
def test_position_limits_are_reckoned_from_where_the_joint_stands(direction: int) -> None:
    device = Dictionary()
    device[0x6064, 0] = 1000
    config = axis_config(amplifier={"counts_per_turn": 4000, "gear_ratio": 2.0, "position_direction": direction})
    config = config.model_copy(update={"limits": config.limits.model_copy(update=LIMITS)})
    guards = Guards(device)
    write_position_limits(guards, config, 0.5)
    per_rad = direction * 2.0 * 4000 / math.tau
    ends = sorted(round(1000 + (end - 0.5) * per_rad) for end in (-1.25, 2.25))
    assert [device[0x607D, 1], device[0x607D, 2]] == ends
    assert guards.kept == [(0x607D, 1, ends[0]), (0x607D, 2, ends[1])]


@pytest.mark.parametrize("index", [0x6080, 0x607F])
def test_a_speed_limit_of_zero_was_never_set(index: int) -> None:
    """No limit at some makers and standing still at others, but never a tighter one of the engineer's."""
    device = Dictionary()
    device[index, 0] = 0
    facts = set_up(device)
    assert device[index, 0] > 100
    assert (index, 0, device[index, 0]) in facts["guards"]
    assert not any(f"0x{index:04X}:0 stands" in note for note in facts["notes"])
    put_back(device, facts["guards_found"])
    assert device[index, 0] == 0


@pytest.mark.parametrize("here", [1000, 500_000, -500_000])
def test_a_range_without_width_was_never_set(here: int) -> None:
    device = Ranged()
    device[0x607D, 1] = device[0x607D, 2] = 0
    device[0x6064, 0] = here
    config = axis_config(amplifier={"counts_per_turn": 4000, "gear_ratio": 2.0})
    config = config.model_copy(update={"limits": config.limits.model_copy(update=LIMITS)})
    guards = Guards(device)
    write_position_limits(guards, config, 0.5)
    assert device[0x607D, 1] < here < device[0x607D, 2]
    assert device[0x607D, 2] - device[0x607D, 1] == pytest.approx(3.5 * 8000 / math.tau, abs=2)
    put_back(device, guards.found)
    assert device[0x607D, 1] == device[0x607D, 2] == 0


@pytest.mark.parametrize(("option", "reaction"), [(2, 3), (4, 3), (5, 1), (8, 1)])
def test_no_option_lets_a_drive_hold_for_ever_after_its_master_died(option: int, reaction: int) -> None:
    """0x605A from 5 on stays in quick stop active, which nobody would end: a fault (0x6007 = 1) ramps and lets go."""
    device = Dictionary()
    configured(device, quick_stop_option=option, heartbeat_reaction=3)
    assert (device[QUICK_STOP], device[ABORT]) == (option, reaction)


def test_a_brake_by_output_has_a_drive_that_holds_until_it_is_closed() -> None:
    device = Dictionary()
    device[0x60FE, 1] = device[0x60FE, 2] = 0
    configured(device, quick_stop_option=6, heartbeat_reaction=3, brake={"by": "output", "output_bit": 16})
    assert device[ABORT] == 3
    device[0x6041, 0] = 0x0007
    with pytest.raises(Unreachable, match="holds the joint in quick stop active"):
        configured(device, quick_stop_option=6)


def test_a_ramp_in_a_makers_unit_is_watched_and_not_reckoned_with() -> None:
    device = Dictionary()
    device[0x6085, 0] = 10_000
    facts = set_up(device, quirks="elmo")
    assert facts["writes_ramp"] is False
    assert (0x6085, 0, 10_000) in facts["guards"]
    assert any("0x6085 is in the maker's unit and reads 10000" in note for note in facts["notes"])
    assert device[0x6085, 0] == 10_000


def test_what_was_found_is_put_back() -> None:
    device = Dictionary()
    before = {key: device[key] for key in ((0x6072, 0), (0x60E0, 0), (0x6080, 0), (0x6065, 0))}
    facts = set_up(device)
    assert before.items() & device.items() == set()
    put_back(device, facts["guards_found"])
    assert before.items() <= device.items()
