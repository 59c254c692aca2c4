"""The behaviour contract of an encoder (servod.runtime.fieldbus.devices), for every encoder driver that is known."""

from __future__ import annotations

import dataclasses
import math

import pytest
from drivers_under_test import (
    COUNTS_PER_TURN,
    MEASURING_RANGE,
    PERIOD_NS,
    EncoderBench,
    by_events_alone,
    names_of,
    plan_of,
)
from hypothesis import given
from hypothesis import strategies as st

from servod.runtime.fieldbus.devices import ALARMS_STALE, NEVER_CYCLES
from servod.runtime.fieldbus.registry import load_driver

RAD = 2 * math.pi / COUNTS_PER_TURN
PERIOD_S = PERIOD_NS * 1e-9
pytestmark = pytest.mark.parametrize("name", names_of("encoder"))


@pytest.fixture
def bench(name: str) -> EncoderBench:
    return EncoderBench(name)


def test_age_is_zero_exactly_with_this_cycles_sample_and_grows_by_one(bench: EncoderBench) -> None:
    ages = []
    for cycle, comes in enumerate((False, True, False, False, True)):
        if comes:
            assert bench.say(0, cycle * PERIOD_NS)
        ages.append(bench.driver.read().age_cycles)
    assert ages[0] > NEVER_CYCLES  # never heard is no fresher than long ago
    assert ages[1:] == [0, 1, 2, 0]


def test_the_first_sample_has_a_position_and_no_velocity(bench: EncoderBench) -> None:
    bench.say(1000, 5 * PERIOD_NS)
    feedback = bench.driver.read()
    assert feedback.position_rad == pytest.approx(1000 * RAD)
    assert feedback.velocity_rad_s == 0.0
    assert feedback.time_ns == 5 * PERIOD_NS


@pytest.mark.parametrize("zero_offset_rad", [0.0, 1.0, -2.5])
def test_the_first_position_is_the_turn_nearest_to_the_zero(name: str, zero_offset_rad: float) -> None:
    bench = EncoderBench(name, zero_offset_rad=zero_offset_rad)
    bench.say(round(zero_offset_rad / RAD) - 1, 0)
    assert bench.driver.read().position_rad == pytest.approx(-RAD, abs=RAD)


@given(
    measuring_range=st.integers(4, 2**32),
    start=st.integers(0, 2**32),
    steps=st.lists(st.floats(-0.49, 0.49), min_size=1, max_size=40),
)
def test_position_is_continuous_over_any_measuring_range(
    name: str, measuring_range: int, start: int, steps: list[float]
) -> None:
    bench = EncoderBench(name, measuring_range_counts=measuring_range)
    bench.say(start, 0)
    first = bench.driver.read().position_rad
    counts = start
    for cycle, step in enumerate(steps, start=1):
        counts += int(step * measuring_range)
        bench.say(counts, cycle * PERIOD_NS)
        moved = bench.driver.read().position_rad - first
        assert moved == pytest.approx((counts - start) * RAD, rel=1e-9, abs=1e-6 * RAD * measuring_range)


@pytest.mark.parametrize("direction", [1, -1])
def test_direction_turns_position_and_velocity(name: str, direction: int) -> None:
    bench = EncoderBench(name, direction=direction)
    for cycle in range(100):
        bench.say(cycle * 100, cycle * PERIOD_NS)
    feedback = bench.driver.read()
    assert feedback.position_rad == pytest.approx(direction * 9900 * RAD)
    assert feedback.velocity_rad_s == pytest.approx(direction * 100 * RAD / PERIOD_S, rel=1e-6)


@given(speed=st.integers(-20_000, 20_000), gaps=st.lists(st.integers(1, 5_000_000), min_size=60, max_size=60))
def test_velocity_uses_the_measured_time_so_uneven_samples_do_not_disturb_it(
    name: str, speed: int, gaps: list[int]
) -> None:
    """A constant speed sampled at any times gives that speed, once the filter has settled; counts are whole."""
    bench = EncoderBench(name)
    time_ns, scale = 0, 1_000_000
    bench.say(0, 0)
    for gap in [PERIOD_NS] * 30 + gaps:
        time_ns += gap
        bench.say(speed * time_ns // scale, time_ns)
    settled = math.exp(-2 * math.pi * 100.0 * time_ns * 1e-9)
    true = speed * RAD * 1e9 / scale
    quantum = 2 * RAD / (min(gaps) * 1e-9) * min(1.0, 2 * math.pi * 100.0 * 5e-3)
    assert bench.driver.read().velocity_rad_s == pytest.approx(true, abs=abs(true) * settled + 2 * quantum + 1e-6)


def test_the_low_pass_has_the_stated_time_constant_at_any_sample_time(name: str) -> None:
    for period_ns in (250_000, PERIOD_NS, 3_000_000):
        bench = EncoderBench(name)
        bench.say(0, 0)
        bench.say(0, period_ns)
        steps = 1 + 10_000_000 // period_ns
        counts = 0
        for step in range(2, 2 + steps):
            counts += 1000
            bench.say(counts, step * period_ns)
        raw = 1000 * RAD / (period_ns * 1e-9)
        expected = raw * (1.0 - math.exp(-2 * math.pi * 100.0 * steps * period_ns * 1e-9))
        assert bench.driver.read().velocity_rad_s == pytest.approx(expected, rel=1e-9)


def test_the_stated_delay_is_what_a_ramp_shows(bench: EncoderBench) -> None:
    """Under constant acceleration the velocity lags by acceleration times delay, once settled."""
    acceleration, samples = 2e8, 300  # counts/s^2
    for cycle in range(samples):
        bench.say(int(0.5 * acceleration * (cycle * PERIOD_S) ** 2), cycle * PERIOD_NS)
    true = acceleration * RAD * (samples - 1) * PERIOD_S
    lag_s = (true - bench.driver.read().velocity_rad_s) / (acceleration * RAD)
    assert lag_s == pytest.approx(bench.driver.delay_s, rel=0.01)


def test_a_missing_sample_leaves_the_values_as_they_were(bench: EncoderBench) -> None:
    for cycle in range(20):
        bench.say(cycle * 50, cycle * PERIOD_NS)
    before = bench.driver.read()
    after = bench.driver.read()
    assert after == before._replace(age_cycles=1)


def test_two_samples_with_one_stamp_do_not_make_a_velocity(bench: EncoderBench) -> None:
    bench.say(0, PERIOD_NS)
    bench.say(500, PERIOD_NS)
    feedback = bench.driver.read()
    assert feedback.velocity_rad_s == 0.0
    assert feedback.position_rad == pytest.approx(500 * RAD)


def test_alarms_come_from_their_own_frame(bench: EncoderBench) -> None:
    assert bench.driver.read().alarms == 0
    assert not bench.say_alarms(0x0001)
    assert bench.driver.read().alarms == 1


def test_short_and_impossible_frames_are_ignored_and_counted(bench: EncoderBench) -> None:
    bench.say(10, 0)
    before = bench.driver.read()
    for can_id in bench.driver.receive_ids:
        assert not bench.driver.on_frame(can_id, b"\x01", PERIOD_NS)
    beyond = (MEASURING_RANGE).to_bytes(4, "little")
    assert not bench.driver.on_frame(bench.position_pdo.cob_id, beyond, PERIOD_NS)
    assert bench.driver.read() == before._replace(age_cycles=1)
    assert bench.driver.ignored_frames == len(bench.driver.receive_ids) + 1  # type: ignore[attr-defined]


def test_an_alarm_word_that_stays_away_is_an_alarm_itself(bench: EncoderBench) -> None:
    timers = bench.alarm_pdo.event_timer_ms  # in cycles of 1 ms
    bench.say_alarms(0)
    for _ in range(3 * timers):
        assert bench.driver.read().alarms == 0
    for _ in range(timers):
        alarms = bench.driver.read().alarms
    assert alarms == ALARMS_STALE
    bench.say_alarms(2)
    assert bench.driver.read().alarms == 2


def test_an_alarm_word_that_follows_events_alone_has_no_age(name: str) -> None:
    plan = plan_of("encoder", name)
    pdos = tuple(by_events_alone(pdo) for pdo in plan.pdos)
    driver = load_driver(name).cyclic(dataclasses.replace(plan, pdos=pdos))
    assert {driver.read().alarms for _ in range(2000)} == {0}
