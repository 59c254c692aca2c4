"""Torque of the virtual drive: clamp order and status bit 11; the other modes on a sticking joint (CiA 402)."""

from __future__ import annotations

import math

import pytest

from servod.drivers.virtual.motion import THERMAL_RESERVE_S, TorqueLimits
from servod.runtime.fieldbus.cia import SW_FOLLOWS_COMMAND, SW_INTERNAL_LIMIT, SW_TARGET_REACHED, Obj402
from servod.runtime.fieldbus.devices import DriveState
from tests.drivers.virtual.bench import AMPLIFIER, Bench

COUNTS_PER_RAD = 1_048_576 / (2 * math.pi)


def produced(bench: Bench) -> tuple[int, int, bool]:
    """Demand 0x6074, torque 0x6077, bit 11."""
    status = bench.read(AMPLIFIER, Obj402.STATUS_WORD)
    demand = bench.read(AMPLIFIER, Obj402.TORQUE_DEMAND, signed=True)
    return demand, bench.read(AMPLIFIER, Obj402.TORQUE_ACTUAL, signed=True), bool(status & SW_INTERNAL_LIMIT)


def test_target_and_offset_add_up(bench: Bench) -> None:
    bench.enabled()
    bench.write(AMPLIFIER, Obj402.TORQUE_OFFSET, 0, -50, 2)
    bench.cycle(0x0F, 350, cycles=2)
    assert produced(bench) == (300, 300, False)
    assert bench.torque_nm == pytest.approx(0.030)
    assert bench.read(AMPLIFIER, Obj402.STATUS_WORD) & SW_FOLLOWS_COMMAND


@pytest.mark.parametrize(
    ("obj", "positive", "negative"),
    [
        (Obj402.MAX_TORQUE, 200, -200),
        (Obj402.MAX_CURRENT, 200, -200),
        (Obj402.POSITIVE_TORQUE_LIMIT, 200, -400),
        (Obj402.NEGATIVE_TORQUE_LIMIT, 400, -200),
    ],
)
def test_each_limit_clamps_and_shows_bit_11(bench: Bench, obj: Obj402, positive: int, negative: int) -> None:
    bench.enabled()
    bench.write(AMPLIFIER, obj, 0, 200, 2)
    bench.cycle(0x0F, 400, cycles=2)
    assert produced(bench) == (400, positive, positive != 400)
    bench.cycle(0x0F, -400, cycles=2)
    assert produced(bench) == (-400, negative, negative != -400)


def test_direction_limits_do_not_weaken_a_quick_stop(bench: Bench) -> None:
    limits = TorqueLimits(bench.world.amplifier.dictionary)
    bench.write(AMPLIFIER, Obj402.POSITIVE_TORQUE_LIMIT, 0, 100, 2)
    assert limits.clamp(900.0, 0.0, stopping=False) == 100
    assert limits.clamp(900.0, 0.0, stopping=True) == 900


def test_speed_guard_takes_only_the_driving_torque(bench: Bench) -> None:
    limits = TorqueLimits(bench.world.amplifier.dictionary)
    assert [limits.clamp(t, 6001.0, stopping=False) for t in (500.0, -500.0)] == [0, -500]
    assert [limits.clamp(t, -6001.0, stopping=False) for t in (500.0, -500.0)] == [500, 0]


def test_motor_protection_falls_back_to_rated_torque_and_recovers(bench: Bench) -> None:
    limits = TorqueLimits(bench.world.amplifier.dictionary)
    limits.warm(2000, THERMAL_RESERVE_S / 3 + 0.1)
    assert limits.hot
    assert limits.clamp(2500.0, 0.0, stopping=False) == 1000
    limits.warm(0, THERMAL_RESERVE_S + 0.5)
    assert not limits.hot
    assert limits.clamp(2500.0, 0.0, stopping=False) == 2500


def test_polarity_turns_torque_and_position(bench: Bench) -> None:
    bench.write(AMPLIFIER, Obj402.POLARITY, 0, 0xA0, 1)
    bench.enabled()
    bench.cycle(0x0F, 1500, cycles=30)
    assert bench.torque_nm == pytest.approx(-0.15)
    assert bench.world.truth().position_rad < 0
    assert bench.read(AMPLIFIER, Obj402.POSITION_ACTUAL, signed=True) > 0


def in_mode(bench: Bench, mode: int) -> None:
    bench.write(AMPLIFIER, Obj402.MODE, 0, mode, 1)
    bench.nmt(1)
    bench.pass_time(0.01)
    for word in (0x06, 0x07, 0x0F):
        bench.cycle(word, cycles=3)


def test_csv_reaches_its_velocity(bench: Bench) -> None:
    in_mode(bench, 9)
    bench.write(AMPLIFIER, Obj402.TARGET_VELOCITY, 0, round(1.5 * COUNTS_PER_RAD), 4)
    bench.cycle(0x0F, cycles=500)
    assert bench.world.truth().velocity_rad_s == pytest.approx(1.5, rel=0.03)
    shown = bench.read(AMPLIFIER, Obj402.VELOCITY_ACTUAL, signed=True) / COUNTS_PER_RAD
    assert shown == pytest.approx(1.5, rel=0.03)


def test_csp_follows_a_position(bench: Bench) -> None:
    in_mode(bench, 8)
    for step in range(1, 201):
        bench.write(AMPLIFIER, Obj402.TARGET_POSITION, 0, round(0.002 * step * COUNTS_PER_RAD), 4)
        bench.cycle(0x0F)
    bench.cycle(0x0F, cycles=500)
    assert bench.world.truth().position_rad == pytest.approx(0.4, abs=0.01)


def test_pp_arrives_and_acknowledges(bench: Bench) -> None:
    in_mode(bench, 1)
    bench.write(AMPLIFIER, Obj402.TARGET_POSITION, 0, round(0.5 * COUNTS_PER_RAD), 4)
    bench.cycle(0x1F, cycles=5)
    status = bench.read(AMPLIFIER, Obj402.STATUS_WORD)
    assert status & SW_FOLLOWS_COMMAND
    assert not status & SW_TARGET_REACHED
    bench.cycle(0x0F, cycles=1500)
    assert bench.read(AMPLIFIER, Obj402.STATUS_WORD) & SW_TARGET_REACHED
    assert bench.world.truth().position_rad == pytest.approx(0.5, abs=0.01)


def test_following_error_faults(bench: Bench) -> None:
    bench.write(AMPLIFIER, Obj402.FOLLOWING_WINDOW, 0, 1000, 4)
    in_mode(bench, 8)
    bench.write(AMPLIFIER, Obj402.MAX_TORQUE, 0, 100, 2)  # 10 mN*m do not break the joint loose
    bench.write(AMPLIFIER, Obj402.TARGET_POSITION, 0, round(0.5 * COUNTS_PER_RAD), 4)
    bench.cycle(0x0F, cycles=400)
    assert bench.state is DriveState.FAULT
    assert bench.read(AMPLIFIER, Obj402.ERROR_CODE) == 0x8611


def test_the_joint_sticks_below_static_friction_and_breaks_loose_above(bench: Bench) -> None:
    bench.enabled()
    bench.cycle(0x0F, 400, cycles=300)
    assert abs(bench.world.truth().position_rad) < 2e-4
    bench.cycle(0x0F, 800, cycles=300)
    assert bench.world.truth().position_rad > 0.01


def test_gear_and_feed_scale_the_position(bench: Bench) -> None:
    bench.world.devices.joint.plant.place(0.25)
    counts = bench.read(AMPLIFIER, 0x6063, signed=True)
    assert counts == round(0.25 * COUNTS_PER_RAD)
    bench.write(AMPLIFIER, Obj402.GEAR_RATIO, 1, 4, 4)
    assert bench.read(AMPLIFIER, Obj402.POSITION_ACTUAL, signed=True) == round(counts / 4)


def test_the_extra_delay_is_the_models_without_one_period() -> None:
    late = Bench({"delay_s": 0.003})
    late.enabled()
    late.cycle(0x0F, 2000)  # arrives after this SYNC, applied at the next
    late.bus.send(0x80, b"")
    late.pass_time(0.0018)
    assert late.world.truth().velocity_rad_s == 0.0
    late.pass_time(0.0005)
    assert late.world.truth().velocity_rad_s > 0.01
