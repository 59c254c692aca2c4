"""A record that does not show the whole scenario does not pass, nor does an axis that went on otherwise than before."""

import math
from collections.abc import Callable
from typing import Any

import pytest

from servod.common.faults import FaultCode
from servod.drivers.virtual.drive_record import DriveSample
from servod.qualify.faults.evidence import Watch, motion_complaints, record_complaints
from servod.qualify.faults.judge import complaints, reaction
from servod.qualify.faults.scenario import Scenario
from servod.qualify.faults.under_test import Observation
from servod.runtime.fieldbus.devices import DriveState

MS = 1_000_000
WATCH = Watch(0, 300 * MS)
OMEGA = 2.0 * math.pi * 2.0
FAULTED = {"axis": ["FAULT"], "reaction_ms": 50, "torque_gone_ms": 50}

Part = Callable[[float], float]


def scenario(start: str, expected: dict[str, Any]) -> Scenario:
    data = {"title": "x", "why": "x", "group": "x", "start": start, "inject": [{"do": {"tell": {"op": "disable"}}}]}
    return Scenario.model_validate({**data, "expect": expected})


def sine(time_ms: float) -> float:
    return 0.0 if time_ms < -500.0 else 0.08 * math.sin(OMEGA * (time_ms + 500.0) / 1e3)


def speed(time_ms: float) -> float:
    return 1.0


def record(until_ms: float, torque: Part, position: Part = sine, velocity: Part = speed) -> list[DriveSample]:
    on = DriveState.OPERATION_ENABLED
    times = [t for t in range(-600, 301, 2) if t <= until_ms]
    return [DriveSample(t * MS, on, 0, 0, 10, 0.1, torque(t), position(t), velocity(t)) for t in times]


def stopped(until_ms: float = 300.0, before_nm: float = 0.1) -> list[DriveSample]:
    """Moving until 10 ms after the injection, then off."""
    rows = record(until_ms, lambda t: before_nm if t <= 10 else 0.0)
    return [s._replace(state=DriveState.SWITCH_ON_DISABLED) if s.time_ns > 10 * MS else s for s in rows]


def judged(samples: list[DriveSample]) -> list[str]:
    seen = Observation(samples, "FAULT", frozenset({FaultCode.FEEDBACK_STALE}), "", 0)
    return complaints(scenario("moving", FAULTED), seen, reaction(samples, 0), WATCH)


def test_a_whole_record_passes() -> None:
    assert judged(stopped()) == []


def test_a_record_cut_at_the_injection_does_not_pass_with_one_sample_without_torque() -> None:
    cut = [*stopped(until_ms=-1.0), stopped()[-1]._replace(time_ns=0)]
    assert reaction(cut, 0).gone_ms == 0.0
    assert "the drive's record ends at the injection" in judged(cut)
    later = [*cut, cut[-1]._replace(time_ns=2 * MS)]
    assert judged(later) == ["the drive's record ends 298 ms before the end of the watch"]


@pytest.mark.parametrize(
    ("start", "samples", "words"),
    [
        ("moving", [], "does not begin before"),
        ("moving", [s for s in stopped() if s.time_ns >= 0], "does not begin before"),
        ("moving", stopped(before_nm=0.0), "felt no torque before"),
        ("enabled", stopped(before_nm=0.0), ""),
        ("proving", stopped(before_nm=0.0), "felt no torque before"),
        ("enabled", [s._replace(state=DriveState.SWITCHED_ON) for s in stopped()], "in SWITCHED_ON at the injection"),
        ("disabled", [s._replace(state=DriveState.SWITCH_ON_DISABLED) for s in stopped()], ""),
        ("disabled", [], "does not begin before"),
        ("off", [], ""),
    ],
)
def test_each_start_has_its_evidence(start: str, samples: list[DriveSample], words: str) -> None:
    found = list(record_complaints(scenario(start, FAULTED), samples, WATCH))
    assert bool(found) is bool(words)
    assert words in " ".join(found)


@pytest.mark.parametrize(
    ("samples", "words"),
    [
        (record(300, speed), ""),
        (stopped(), "the drive went to SWITCH_ON_DISABLED on the way"),
        (record(300, speed, lambda t: sine(min(t, 0.0))), "rad from its motion, expected 0.03 rad"),
        (record(300, speed, lambda t: sine(t) + (0.04 if t == 100 else 0.0)), "the joint was 0.04"),
        (record(300, speed, lambda t: math.nan if t == 100 else sine(t)), "is not finite"),
        (record(300, speed, sine, lambda t: 5.1 if t == 100 else 1.0), "turned at 5.1 rad/s, expected 2 rad/s"),
        (record(300, speed, lambda t: 0.0), "nan rad from its motion"),
    ],
)
def test_an_axis_that_stays_enabled_goes_on_as_before(samples: list[DriveSample], words: str) -> None:
    found = list(motion_complaints(scenario("moving", {"axis": ["ENABLED"]}), samples, WATCH))
    assert bool(found) is bool(words)
    assert words in " ".join(found)


def test_an_axis_at_rest_stays_where_it_was() -> None:
    resting = scenario("enabled", {"axis": ["ENABLED"]})
    assert list(motion_complaints(resting, record(300, speed, lambda t: 1.0), WATCH)) == []
    assert list(motion_complaints(resting, record(300, speed, lambda t: 1.0 if t < 200 else 1.1), WATCH))
