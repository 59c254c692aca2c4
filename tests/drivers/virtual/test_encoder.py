"""The virtual encoder (CiA 406): wrap at any range, preset, scaling, direction, alarms, cyclic timer."""

from __future__ import annotations

import itertools
import math
from typing import Any

import pytest

from servod.common.units import wrapped_difference
from servod.runtime.fieldbus.cia import Abort, NmtCommand, Obj406
from tests.drivers.virtual.bench import ENCODER, Bench, abort_code

TURN = 1_048_576


def bench_at(position_rad: float, **settings: Any) -> Bench:
    return Bench(start_position_rad=position_rad, **settings)


@pytest.mark.parametrize("measuring_range", [TURN, 1_000_000, 3_600_007, 2**32 - 1])
@pytest.mark.parametrize("turns", [-3.7, -1e-6, 0.0, 0.4, 12.25])
def test_the_position_wraps_at_any_range(measuring_range: int, turns: float) -> None:
    bench = bench_at(turns * 2 * math.pi, encoder_measuring_range_counts=measuring_range)
    position = bench.read(ENCODER, Obj406.POSITION)
    assert 0 <= position < measuring_range
    expected = math.floor(turns * TURN + 0.5) % measuring_range
    assert abs(wrapped_difference(position, expected, measuring_range)) <= 1


def test_moving_through_the_wrap_is_continuous() -> None:
    bench = bench_at(0.0, encoder_measuring_range_counts=1_000_003)
    bench.operational()
    positions = []
    for step in range(-20, 20):
        bench.world.devices.joint.plant.place(step * 1e-4)
        bench.cycle()
        positions.append(int.from_bytes(bench.frames(0x282)[-1], "little"))
    steps = [wrapped_difference(b, a, 1_000_003) for a, b in itertools.pairwise(positions)]
    assert min(positions) < 1000
    assert max(positions) > 999_000
    assert all(abs(step - 16.7) < 1.5 for step in steps)


def test_preset_moves_the_position_and_the_offset() -> None:
    bench = bench_at(1.0, encoder_measuring_range_counts=1_000_003)
    before = bench.read(ENCODER, Obj406.POSITION)
    bench.write(ENCODER, Obj406.PRESET, 0, 5, 4)
    assert bench.read(ENCODER, Obj406.POSITION) == 5
    offset = bench.read(ENCODER, Obj406.OFFSET, signed=True)
    assert (before + offset) % 1_000_003 == 5
    too_high = abort_code(lambda: bench.write(ENCODER, Obj406.PRESET, 0, 1_000_003, 4))
    assert too_high is Abort.VALUE_TOO_HIGH


def test_preset_is_refused_while_moving() -> None:
    bench = bench_at(0.0)
    bench.world.devices.joint.plant.place(0.0, 5.0)
    assert abort_code(lambda: bench.write(ENCODER, Obj406.PRESET, 0, 0, 4)) is Abort.PRESENT_STATE


def test_scaling_and_code_sequence() -> None:
    bench = bench_at(math.pi)
    bench.write(ENCODER, Obj406.UNITS_PER_TURN, 0, 36_000, 4)
    assert bench.read(ENCODER, Obj406.POSITION) == 18_000
    bench.write(ENCODER, Obj406.OPERATING_PARAMETERS, 0, 0, 2)  # scaling off
    assert bench.read(ENCODER, Obj406.POSITION) == TURN // 2
    bench.write(ENCODER, Obj406.OPERATING_PARAMETERS, 0, 1, 2)  # the other direction
    assert bench.read(ENCODER, Obj406.POSITION) == 2**31 - TURN // 2
    assert bench.read(ENCODER, Obj406.OPERATING_STATUS) == 1


def test_noise_is_noise_and_repeats_with_the_seed() -> None:
    def readings(seed: int) -> list[bytes]:
        bench = bench_at(0.5, encoder_noise_counts=20.0, seed=seed)
        bench.operational()
        bench.cycle(cycles=200)
        return bench.frames(0x282)

    first = readings(3)
    values = [int.from_bytes(data, "little") for data in first]
    mean = sum(values) / len(values)
    deviation = math.sqrt(sum((v - mean) ** 2 for v in values) / len(values))
    assert 15 < deviation < 25
    assert readings(3) == first
    assert readings(4) != first


def test_alarms_travel_by_event_and_emergency() -> None:
    bench = bench_at(0.0)
    bench.nmt(NmtCommand.START)
    bench.heard.clear()
    bench.write(ENCODER, 0x2000, 1, 1, 2)
    bench.pass_time(0.002)
    assert bench.frames(0x182)[0] == b"\x01\x00"
    assert bench.frames(0x082)[0][:2] == b"\x00\x73"
    bench.write(ENCODER, 0x2000, 1, 0, 2)
    bench.pass_time(0.002)
    assert bench.frames(0x082)[-1][:3] == b"\0\0\0"


def test_cyclic_timer_is_the_event_timer_of_the_first_tpdo() -> None:
    bench = bench_at(0.0)
    bench.write(ENCODER, Obj406.CYCLIC_TIMER, 0, 20, 2)
    assert bench.read(ENCODER, 0x1800, 5) == 20
    bench.nmt(NmtCommand.START)
    bench.heard.clear()
    bench.pass_time(1.0)
    assert 48 <= len(bench.frames(0x182)) <= 51


def test_speed_in_hundredths_of_a_turn_per_minute() -> None:
    bench = bench_at(0.0)
    plant = bench.world.devices.joint.plant
    bench.read(ENCODER, Obj406.SPEED, 1)
    plant.place(0.0, 6.0)
    start = plant.position_rad
    bench.pass_time(0.002)
    start_ns = bench.world.clock.now_ns()
    bench.read(ENCODER, Obj406.SPEED, 1)
    bench.pass_time(0.002)
    speed = bench.read(ENCODER, Obj406.SPEED, 1, signed=True)
    assert plant.position_rad > start
    assert bench.world.clock.now_ns() > start_ns
    assert 0 < speed < 6.0 * 60 / (2 * math.pi) * 100


def test_cam_follows_its_limits() -> None:
    bench = bench_at(math.pi)
    bench.write(ENCODER, 0x6301, 1, 1, 1)
    bench.write(ENCODER, 0x6320, 1, TURN, 4)
    assert bench.read(ENCODER, 0x6300, 1) == 1
    bench.write(ENCODER, 0x6302, 1, 1, 1)
    assert bench.read(ENCODER, 0x6300, 1) == 0
