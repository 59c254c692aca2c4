"""Power states (CiA 402): all transitions by SDO and PDO, every forbidden one refused, SYNC timing, stops."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

import pytest

from servod.drivers.virtual.power_state import TRANSITIONS, DriveCommand, decode_command
from servod.runtime.fieldbus.cia import STATUS_WORD_TABLE, Obj402
from servod.runtime.fieldbus.devices import DriveState
from tests.drivers.virtual.bench import AMPLIFIER, Bench

S = DriveState
WORDS = {
    DriveCommand.DISABLE_VOLTAGE: 0x00,
    DriveCommand.QUICK_STOP: 0x02,
    DriveCommand.SHUTDOWN: 0x06,
    DriveCommand.SWITCH_ON: 0x07,
    DriveCommand.ENABLE_OPERATION: 0x0F,
}
PATHS = {
    S.SWITCH_ON_DISABLED: (0x00,),
    S.READY_TO_SWITCH_ON: (0x00, 0x06),
    S.SWITCHED_ON: (0x00, 0x06, 0x07),
    S.OPERATION_ENABLED: (0x00, 0x06, 0x07, 0x0F),
    S.QUICK_STOP_ACTIVE: (0x00, 0x06, 0x07, 0x0F, 0x02),
}
Order = Callable[[Bench, int], None]


def by_sdo(bench: Bench, word: int) -> None:
    bench.write(AMPLIFIER, Obj402.CONTROL_WORD, 0, word, 2)
    bench.pass_time(0.02)


def by_pdo(bench: Bench, word: int) -> None:
    bench.cycle(word, cycles=20)


def shown(bench: Bench) -> DriveState:
    word = bench.read(AMPLIFIER, Obj402.STATUS_WORD)
    matches = [state for mask, value, state in STATUS_WORD_TABLE if word & mask == value]
    assert len(matches) == 1
    return matches[0]


@pytest.mark.parametrize("order", [by_sdo, by_pdo])
@pytest.mark.parametrize("state", PATHS)
@pytest.mark.parametrize("command", DriveCommand)
def test_every_pair_of_state_and_command(state: DriveState, command: DriveCommand, order: Order) -> None:
    bench = Bench()
    bench.write(AMPLIFIER, Obj402.QUICK_STOP_OPTION, 0, 6, 2)  # stay in quick stop active
    bench.operational()
    for word in PATHS[state]:
        order(bench, word)
    assert shown(bench) is state
    order(bench, WORDS[command])
    expected = TRANSITIONS.get((state, command), (0, state))[1]
    if state is S.READY_TO_SWITCH_ON and command is DriveCommand.ENABLE_OPERATION:
        expected = S.OPERATION_ENABLED  # 3, and 4 follows by itself
    assert shown(bench) is expected


@pytest.mark.parametrize("order", [by_sdo, by_pdo])
def test_fault_and_reset_by_edge_when_the_cause_is_gone(order: Order) -> None:
    bench = Bench()
    bench.operational()
    for word in PATHS[S.OPERATION_ENABLED]:
        order(bench, word)
    bench.write(AMPLIFIER, 0x2000, 1, 0x7121, 2)
    bench.pass_time(0.3)
    assert shown(bench) is S.FAULT  # 13, 14
    order(bench, 0x80)
    assert shown(bench) is S.FAULT  # the cause is still there
    bench.write(AMPLIFIER, 0x2000, 1, 0, 2)
    order(bench, 0x80)
    assert shown(bench) is S.FAULT  # held high is no edge
    order(bench, 0x00)
    order(bench, 0x80)
    assert shown(bench) is S.SWITCH_ON_DISABLED  # 15
    assert bench.read(AMPLIFIER, Obj402.ERROR_CODE) == 0


def test_no_ready_without_supply_or_with_safe_torque_off(bench: Bench) -> None:
    for subindex, value, size in ((3, 5000, 4), (2, 1, 1)):
        bench.write(AMPLIFIER, 0x2000, subindex, value, size)
        by_sdo(bench, 0x06)
        assert shown(bench) is S.SWITCH_ON_DISABLED
        bench.write(AMPLIFIER, 0x2000, subindex, 48000 if subindex == 3 else 0, size)
    by_sdo(bench, 0x06)
    assert shown(bench) is S.READY_TO_SWITCH_ON


@pytest.mark.parametrize(("subindex", "value", "size", "code"), [(3, 5000, 4, 0x3220), (2, 1, 1, 0x5441)])
def test_losing_power_faults_and_cuts_at_once(bench: Bench, subindex: int, value: int, size: int, code: int) -> None:
    bench.spinning()
    bench.write(AMPLIFIER, 0x2000, subindex, value, size)
    assert (bench.state, bench.torque_nm) == (S.FAULT, 0.0)
    assert bench.read(AMPLIFIER, Obj402.ERROR_CODE) == code


def test_a_control_word_acts_at_sync_and_shows_one_sync_later(bench: Bench) -> None:
    bench.operational()
    bench.bus.send(0x201, struct.pack("<Hh", 0x06, 0))
    bench.pass_time(0.005)
    assert bench.state is S.SWITCH_ON_DISABLED
    bench.heard.clear()
    bench.cycle()
    assert bench.state is S.READY_TO_SWITCH_ON
    bench.cycle()
    words = [int.from_bytes(data[:2], "little") & 0x6F for data in bench.frames(0x181)]
    assert words == [0x60, 0x21]


def test_the_whole_rpdo_counts_before_the_control_word(bench: Bench) -> None:
    """Torque is mapped after the control word, and yet it is the torque with which the drive starts."""
    bench.operational()
    bench.cycle(0x06, cycles=2)
    bench.cycle(0x07, cycles=2)
    bench.cycle(0x0F, 300)
    assert bench.torque_nm == 0.0
    bench.bus.send(0x80, b"")
    bench.pass_time(0.0001)
    assert bench.state is S.OPERATION_ENABLED
    assert bench.torque_nm == pytest.approx(0.030)


def test_targets_are_ignored_unless_enabled(bench: Bench) -> None:
    bench.operational()
    for word in (0x00, 0x06, 0x07):
        bench.cycle(word, 500, cycles=3)
        assert bench.torque_nm == 0.0


def test_6061_follows_6060_with_delay(bench: Bench) -> None:
    bench.write(AMPLIFIER, Obj402.MODE, 0, 10, 1)
    assert bench.read(AMPLIFIER, Obj402.MODE_DISPLAY) == 0
    bench.pass_time(0.01)
    assert bench.read(AMPLIFIER, Obj402.MODE_DISPLAY) == 10


@pytest.mark.parametrize("option", range(9))
def test_quick_stop_by_every_option(bench: Bench, option: int) -> None:
    bench.write(AMPLIFIER, Obj402.QUICK_STOP_OPTION, 0, option, 2)
    bench.spinning()
    bench.cycle(0x02, 2000, cycles=2)
    if option == 0:
        assert (bench.state, bench.torque_nm) == (S.SWITCH_ON_DISABLED, 0.0)
        return
    assert bench.state is S.QUICK_STOP_ACTIVE
    bench.cycle(0x02, 2000, cycles=300)
    assert abs(bench.world.truth().velocity_rad_s) < 0.05
    assert bench.state is (S.QUICK_STOP_ACTIVE if option >= 5 else S.SWITCH_ON_DISABLED)
    bench.cycle(0x0F, 0, cycles=3)
    assert bench.state is (S.OPERATION_ENABLED if option >= 5 else S.SWITCH_ON_DISABLED)  # 16


def test_quick_stop_brakes_along_its_ramp(bench: Bench) -> None:
    """With 30 rad/s^2, 3 rad/s take 100 ms: the drive must hold the speed up against friction, not just let go."""
    counts_per_rad = 1_048_576 / 6.283185307179586
    bench.write(AMPLIFIER, Obj402.QUICK_STOP_DECELERATION, 0, round(30 * counts_per_rad), 4)
    bench.spinning(3.0)
    start = bench.world.truth().velocity_rad_s
    bench.cycle(0x02, cycles=1 + round(start / 30 / 2 * 1000))
    assert bench.world.truth().velocity_rad_s == pytest.approx(start / 2, rel=0.25)


def braked(joint: dict[str, Any], speed_rad_s: float, load_nm: float = 0.0) -> tuple[float, float]:
    """(ms until the drive has switched off, rad) of a quick stop with 200 rad/s^2 while it gives all it has."""
    bench = Bench(joint)
    bench.enabled()
    bench.cycle(0x0F, 3000, cycles=2)
    bench.world.devices.joint.plant.place(0.0, speed_rad_s)
    bench.world.devices.joint.load_nm = load_nm
    bench.cycle(0x02, 3000)
    start_ns, start_rad = bench.world.clock.now_ns(), bench.world.truth().position_rad
    while bench.state is not S.SWITCH_ON_DISABLED and bench.world.clock.now_ns() - start_ns < 1e9:
        bench.cycle(0x02, 3000)
    return (bench.world.clock.now_ns() - start_ns) / 1e6, bench.world.truth().position_rad - start_rad


LIGHT = {"inertia": 0.001, "friction": {"kind": "coulomb_viscous", "coulomb": 0.005, "viscous": 0.0}}


def test_a_quick_stop_ends_with_its_ramp() -> None:
    """2.3 rad/s at 200 rad/s^2 take 11.5 ms; the torque that drove the joint has no part in it."""
    time_ms, way_rad = braked(LIGHT, 2.3)
    assert time_ms <= 20.0
    assert way_rad <= 2.3 * 2.3 / 400.0 + 2.3 * 0.006


def test_a_quick_stop_goes_on_until_the_joint_rests() -> None:
    """30 rad/s^2 is all that 0.3 N*m do to a heavy joint: its 0.1 s are not cut short. A load is let go at rest."""
    time_ms, way_rad = braked(LIGHT | {"inertia": 0.01}, 3.0)
    assert 95.0 <= time_ms <= 125.0
    assert way_rad == pytest.approx(3.0 * 3.0 / 60.0, rel=0.15)
    time_ms, way_rad = braked(LIGHT, 2.3, load_nm=0.1)
    assert time_ms <= 40.0
    assert way_rad <= 0.05


def test_a_load_that_the_torque_cannot_stop_is_braked_on() -> None:
    time_ms, _ = braked(LIGHT | {"inertia": 0.01}, 1.0, load_nm=0.32)
    assert time_ms >= 1000.0


@pytest.mark.parametrize(("word", "target"), [(0x07, S.SWITCHED_ON), (0x06, S.READY_TO_SWITCH_ON)])
def test_disable_and_shutdown_with_a_ramp(bench: Bench, word: int, target: DriveState) -> None:
    bench.write(AMPLIFIER, Obj402.DISABLE_OPTION, 0, 1, 2)
    bench.write(AMPLIFIER, Obj402.SHUTDOWN_OPTION, 0, 1, 2)
    bench.spinning()
    bench.cycle(word, cycles=2)
    assert bench.state is S.OPERATION_ENABLED
    bench.cycle(word, cycles=400)
    assert (bench.state, bench.torque_nm) == (target, 0.0)


@pytest.mark.parametrize("option", range(1, 5))
def test_halt_stops_and_stays_enabled(bench: Bench, option: int) -> None:
    bench.write(AMPLIFIER, Obj402.HALT_OPTION, 0, option, 2)
    bench.spinning()
    bench.cycle(0x10F, 2000, cycles=400)
    assert bench.state is S.OPERATION_ENABLED
    assert abs(bench.world.truth().velocity_rad_s) < 0.05
    assert bench.read(AMPLIFIER, Obj402.STATUS_WORD) & 1 << 10
    bench.cycle(0x0F, 500, cycles=3)
    assert bench.torque_nm == pytest.approx(0.05)


@pytest.mark.parametrize("option", range(5))
def test_fault_reaction_by_every_option(bench: Bench, option: int) -> None:
    bench.write(AMPLIFIER, Obj402.FAULT_REACTION_OPTION, 0, option, 2)
    bench.spinning()
    bench.write(AMPLIFIER, 0x2000, 1, 0x7121, 2)
    assert bench.state is (S.FAULT if option == 0 else S.FAULT_REACTION_ACTIVE)
    bench.pass_time(0.5)
    assert (bench.state, bench.torque_nm) == (S.FAULT, 0.0)


@pytest.mark.parametrize("word", range(16))
def test_every_word_is_one_command(word: int) -> None:
    assert decode_command(word | 0xFF00) is decode_command(word)
    assert (decode_command(word) is DriveCommand.DISABLE_VOLTAGE) is not bool(word & 2)
