"""The behaviour contract of an amplifier (servod.runtime.fieldbus.devices), for every amplifier driver that is
known."""

from __future__ import annotations

import dataclasses
import itertools
import math

import pytest
from drivers_under_test import (
    RATED_TORQUE_MNM,
    STATUS_WORD,
    AmplifierBench,
    by_events_alone,
    find_pdo,
    names_of,
    plan_of,
)
from hypothesis import given
from hypothesis import strategies as st

from servod.runtime.fieldbus.cia import CW_DISABLE_VOLTAGE, CW_FAULT_RESET, CW_HALT, Obj402
from servod.runtime.fieldbus.devices import (
    HANDSHAKE_SYNCS,
    NEVER_CYCLES,
    AmplifierFeedback,
    DriveState,
    Goal,
    Mode,
    Reason,
)
from servod.runtime.fieldbus.registry import load_driver

RATED_NM = RATED_TORQUE_MNM * 1e-3
ENABLED = DriveState.OPERATION_ENABLED
pytestmark = pytest.mark.parametrize("name", names_of("amplifier"))


@pytest.fixture
def bench(name: str) -> AmplifierBench:
    return AmplifierBench(name)


def test_before_the_first_feedback_the_state_is_unknown(bench: AmplifierBench) -> None:
    feedback = bench.driver.read()
    assert feedback.state is DriveState.UNKNOWN
    assert feedback.age_cycles >= NEVER_CYCLES
    assert not feedback.goal_reached
    assert feedback.reasons & Reason.NO_FEEDBACK


def test_age_is_zero_exactly_with_this_cycles_feedback_and_grows_by_one(bench: AmplifierBench) -> None:
    ages = []
    for comes in (True, False, False, True, False):
        if comes:
            assert bench.say(DriveState.SWITCH_ON_DISABLED)
        ages.append(bench.driver.read().age_cycles)
        bench.ask(Goal.OFF)
    assert ages == [0, 1, 2, 0, 1]


def test_read_gives_the_same_value_until_the_next_frames(bench: AmplifierBench) -> None:
    bench.say(DriveState.SWITCHED_ON, position=5)
    assert bench.driver.read() is bench.driver.read()
    bench.say(DriveState.SWITCHED_ON, position=6)
    assert bench.driver.read().position_rad != 0.0


def test_stale_feedback_takes_the_goal_away(bench: AmplifierBench) -> None:
    bench.say_mode(bench.plan.facts["mode"])
    bench.cycle(ENABLED, Goal.ENABLED)
    bench.say(ENABLED)
    assert bench.driver.read().goal_reached
    for _ in range(HANDSHAKE_SYNCS):
        bench.ask(Goal.ENABLED)
    assert bench.driver.read().reasons == Reason.NO_FEEDBACK


@pytest.mark.parametrize("state", list(DriveState))
@pytest.mark.parametrize("goal", list(Goal))
def test_torque_is_encoded_only_when_enabled_and_wanted(bench: AmplifierBench, state: DriveState, goal: Goal) -> None:
    _, torque = bench.cycle(state, goal, torque_nm=0.5)
    wanted = round(0.5 / RATED_NM * 1000) if (state is ENABLED and goal is Goal.ENABLED) else 0
    assert torque == wanted


@pytest.mark.parametrize("torque_nm", [math.nan, math.inf, -math.inf])
def test_torque_that_is_not_finite_never_reaches_the_wire(bench: AmplifierBench, torque_nm: float) -> None:
    assert bench.cycle(ENABLED, Goal.ENABLED, torque_nm) == (CW_DISABLE_VOLTAGE, 0)


@given(torque_nm=st.floats(allow_nan=True, allow_infinity=True))
def test_any_float_gives_a_frame_and_never_more_than_sixteen_bits(name: str, torque_nm: float) -> None:
    word, torque = AmplifierBench(name).cycle(ENABLED, Goal.ENABLED, torque_nm)
    per_mille = torque_nm / RATED_NM * 1000  # the largest floats overflow here
    if math.isfinite(per_mille):
        assert torque == max(-32767, min(32767, round(per_mille)))
    else:
        assert (word, torque) == (CW_DISABLE_VOLTAGE, 0)


def test_an_unknown_status_word_is_unknown_and_gets_disable_voltage(bench: AmplifierBench) -> None:
    word, torque = bench.cycle(DriveState.UNKNOWN, Goal.ENABLED, 0.5)
    bench.say(DriveState.UNKNOWN)
    feedback = bench.driver.read()
    assert (word, torque) == (CW_DISABLE_VOLTAGE, 0)
    assert feedback.state is DriveState.UNKNOWN
    assert feedback.reasons & Reason.STATE_UNKNOWN
    assert feedback.status_word == STATUS_WORD[DriveState.UNKNOWN]


@pytest.mark.parametrize("goal", list(Goal))
def test_a_fault_is_never_reset_unasked(bench: AmplifierBench, goal: Goal) -> None:
    words = [bench.cycle(DriveState.FAULT, goal)[0] for _ in range(20)]
    assert not any(word & CW_FAULT_RESET for word in words)


def rising_edges(words: list[int]) -> int:
    bits = [0] + [word & CW_FAULT_RESET for word in words]
    return sum(now > before for before, now in itertools.pairwise(bits))


def test_one_rising_edge_for_a_request_that_is_held(bench: AmplifierBench) -> None:
    words = [bench.cycle(DriveState.FAULT, Goal.ENABLED, reset_fault=True)[0] for _ in range(20)]
    assert rising_edges(words) == 1
    assert words[-1] & CW_FAULT_RESET == 0


@pytest.mark.parametrize("gap", [1, 2, 5])
def test_one_rising_edge_for_each_request(bench: AmplifierBench, gap: int) -> None:
    words = [
        bench.cycle(DriveState.FAULT, Goal.OFF, reset_fault=request)[0] for request in [True] + [False] * gap + [True]
    ]
    words += [bench.cycle(DriveState.FAULT, Goal.OFF)[0] for _ in range(10)]
    assert rising_edges(words) == 2


def test_a_request_without_a_fault_is_not_kept(bench: AmplifierBench) -> None:
    bench.cycle(DriveState.SWITCH_ON_DISABLED, Goal.OFF, reset_fault=True)
    words = [bench.cycle(DriveState.FAULT, Goal.OFF)[0] for _ in range(5)]
    assert rising_edges(words) == 0


def test_the_driver_waits_for_the_handshake_before_it_judges(bench: AmplifierBench) -> None:
    reasons = []
    for _ in range(HANDSHAKE_SYNCS + 1):
        bench.ask(Goal.ENABLED)
        bench.say(DriveState.NOT_READY_TO_SWITCH_ON)
        reasons.append(bench.driver.read().reasons)
    assert reasons[:HANDSHAKE_SYNCS] == [Reason.HANDSHAKE] * HANDSHAKE_SYNCS
    assert reasons[-1] & Reason.NOT_READY


@pytest.mark.parametrize(
    ("state", "flags_off", "reason"),
    [
        (DriveState.FAULT, 0, Reason.IN_FAULT),
        (DriveState.FAULT_REACTION_ACTIVE, 0, Reason.IN_FAULT),
        (DriveState.NOT_READY_TO_SWITCH_ON, 0, Reason.NOT_READY),
        (DriveState.SWITCH_ON_DISABLED, 0x0010, Reason.NO_VOLTAGE),
        (DriveState.SWITCH_ON_DISABLED, 0x0200, Reason.REMOTE_OFF),
    ],
)
def test_the_reason_names_what_is_missing(
    bench: AmplifierBench, state: DriveState, flags_off: int, reason: Reason
) -> None:
    for _ in range(2 * HANDSHAKE_SYNCS):
        bench.ask(Goal.ENABLED)
        bench.time_ns += 1
        word = STATUS_WORD[state] & ~flags_off
        bench.driver.on_frame(bench.feedback_pdo.cob_id, word.to_bytes(2, "little") + bytes(6), bench.time_ns)
        feedback = bench.driver.read()
    assert feedback.reasons & reason
    assert not feedback.goal_reached


def feedback_when_enabled(bench: AmplifierBench, mode: int) -> AmplifierFeedback:
    bench.say_mode(mode)
    for _ in range(2 * HANDSHAKE_SYNCS):
        bench.cycle(ENABLED, Goal.ENABLED)
    bench.say(ENABLED)
    return bench.driver.read()


def test_enabled_is_reached_only_in_the_wanted_mode(bench: AmplifierBench) -> None:
    wrong = feedback_when_enabled(bench, Mode.HOMING)
    assert not wrong.goal_reached
    assert wrong.reasons == Reason.MODE_NOT_SHOWN
    right = feedback_when_enabled(bench, bench.plan.facts["mode"])
    assert right.goal_reached
    assert right.reasons == 0
    assert right.mode == bench.plan.facts["mode"]


@pytest.mark.parametrize(("state", "shown"), [(ENABLED, Mode.NONE), (DriveState.SWITCHED_ON, -1)])
def test_a_mode_that_is_not_shown_any_more_is_not_known(bench: AmplifierBench, state: DriveState, shown: int) -> None:
    mode, timers = bench.plan.facts["mode"], bench.slow_pdo.event_timer_ms  # in cycles of 1 ms
    bench.say_mode(mode, error_code=0x7305)
    for _ in range(3 * timers):
        torque = bench.cycle(state, Goal.ENABLED, 0.5)[1]
        assert bench.driver.read().mode == mode
    for _ in range(timers):
        last = bench.cycle(state, Goal.ENABLED, 0.5)[1]
    bench.say(state)
    feedback = bench.driver.read()
    assert (feedback.mode, feedback.error_code) == (shown, 0x7305)
    assert feedback.reasons & Reason.MODE_NOT_SHOWN
    assert last == torque  # the axis is brought down by the loop, not dropped
    bench.say_mode(mode)
    bench.cycle(state, Goal.ENABLED)
    assert bench.driver.read().mode == mode


def test_a_mode_that_follows_events_alone_has_no_age(name: str) -> None:
    plan = plan_of("amplifier", name)
    pdos = tuple(by_events_alone(pdo) for pdo in plan.pdos)
    bench = AmplifierBench(name)
    bench.driver = load_driver(name).cyclic(dataclasses.replace(plan, pdos=pdos))
    bench.say_mode(plan.facts["mode"])
    for _ in range(2000):
        bench.cycle(ENABLED, Goal.ENABLED)
    assert bench.driver.read().mode == plan.facts["mode"]


def test_no_target_reaches_a_drive_that_shows_another_mode(bench: AmplifierBench) -> None:
    bench.say_mode(Mode.PROFILE_TORQUE)
    assert bench.cycle(ENABLED, Goal.ENABLED, 0.5)[1] == 0


def test_halt_sets_its_bit_and_is_a_reason(bench: AmplifierBench) -> None:
    bench.say_mode(bench.plan.facts["mode"])
    word, _ = bench.cycle(ENABLED, Goal.ENABLED, halt=True)
    bench.say(ENABLED)
    assert word & CW_HALT
    assert bench.driver.read().reasons == Reason.HALTED
    assert not bench.cycle(ENABLED, Goal.ENABLED)[0] & CW_HALT


def test_going_back_from_quick_stop_carries_the_torque_now_produced(name: str) -> None:
    bench = AmplifierBench(name, quick_stop_option=6)
    bench.say(DriveState.QUICK_STOP_ACTIVE, torque=-123)
    assert bench.ask(Goal.ENABLED, 0.5) == (0x000F, -123)


def test_short_frames_are_ignored_and_counted(bench: AmplifierBench) -> None:
    bench.say(DriveState.SWITCHED_ON, position=7)
    before = bench.driver.read()
    for can_id in bench.driver.receive_ids:
        assert not bench.driver.on_frame(can_id, b"\x00", bench.time_ns + 1)
    assert bench.driver.read() is before
    assert bench.driver.ignored_frames == len(bench.driver.receive_ids)  # type: ignore[attr-defined]


def test_error_code_comes_from_slow_pdo_and_emcy(bench: AmplifierBench) -> None:
    assert not bench.say_mode(0, error_code=0x7305)
    bench.say(DriveState.FAULT)
    assert bench.driver.read().error_code == 0x7305
    assert not bench.say_emcy(0x8130)
    bench.say(DriveState.FAULT)
    assert bench.driver.read().error_code == 0x8130


@pytest.mark.parametrize(("position_direction", "torque_direction"), [(1, 1), (-1, 1), (1, -1), (-1, -1)])
def test_directions_gear_and_units(name: str, position_direction: int, torque_direction: int) -> None:
    bench = AmplifierBench(
        name, gear_ratio=4.0, position_direction=position_direction, torque_direction=torque_direction
    )
    bench.say(ENABLED, position=250_000, torque=100)
    feedback = bench.driver.read()
    assert feedback.position_rad == pytest.approx(position_direction * 2 * math.pi / 4 / 4)
    assert feedback.torque_nm == pytest.approx(torque_direction * 0.1 * RATED_NM * 4.0)
    assert bench.ask(Goal.ENABLED, feedback.torque_nm)[1] == 100


@given(steps=st.lists(st.integers(-(2**30), 2**30), min_size=1, max_size=30))
def test_the_amplifiers_position_is_continuous_over_its_32_bits(name: str, steps: list[int]) -> None:
    bench = AmplifierBench(name)
    true = 0
    bench.say(ENABLED)
    for step in steps:
        true += step
        bench.say(ENABLED, position=true)
    assert bench.driver.read().position_rad == pytest.approx(true * 2 * math.pi / 1_000_000, abs=1e-9, rel=1e-12)


def test_the_plan_maps_what_the_cycle_sends(bench: AmplifierBench) -> None:
    assert set(bench.driver.receive_ids) >= {bench.feedback_pdo.cob_id, bench.slow_pdo.cob_id}
    assert bench.driver.sync_frames == 1
    assert find_pdo(bench.plan, Obj402.CONTROL_WORD).receive
