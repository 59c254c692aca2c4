"""The judge complains of everything that is not as expected, and of nothing else."""

import math

import pytest

from servod.common.faults import FaultCode
from servod.drivers.virtual.drive_record import DriveSample
from servod.qualify.faults.evidence import Watch
from servod.qualify.faults.judge import complaints, reaction
from servod.qualify.faults.scenario import Scenario
from servod.qualify.faults.under_test import Observation
from servod.runtime.fieldbus.devices import DriveState
from servod.runtime.loop.wiring.findings import WiringOutcome

MS = 1_000_000
ON, OFF = DriveState.OPERATION_ENABLED, DriveState.SWITCH_ON_DISABLED


def sample(time_ms: float, state: DriveState, torque_nm: float) -> DriveSample:
    return DriveSample(round(time_ms * MS), state, 0, 0, 10, torque_nm, torque_nm, 0.0, 0.0)


STOPPED = [sample(0, ON, 0.1), sample(10, ON, 0.1), sample(20, OFF, 0.05), sample(30, OFF, 0.0), sample(40, OFF, 0.0)]
HELD = [sample(time_ms, ON, 0.1) for time_ms in range(-10, 30, 10)]
RUNAWAY = [sample(0, ON, 0.1), sample(10, ON, 0.1), sample(20, OFF, 0.1)]


def seen(
    samples: list[DriveSample] = STOPPED,
    axis: str = "FAULT",
    refusal: str = "",
    lost: int = 0,
    says: WiringOutcome | None = None,
    errors: tuple[int, ...] = (),
) -> Observation:
    return Observation(samples, axis, frozenset({FaultCode.FEEDBACK_STALE}), refusal, lost, says, frozenset(errors))


def test_times_count_from_the_injection() -> None:
    assert reaction(STOPPED, 5 * MS).left_ms == 15.0
    assert reaction(STOPPED, 5 * MS).gone_ms == 25.0
    assert reaction(RUNAWAY, 0).gone_ms is None
    assert reaction([*STOPPED[:4], sample(40, OFF, math.nan)], 0).gone_ms is None
    assert reaction(STOPPED, 100 * MS).left_ms is None


@pytest.mark.parametrize(
    ("expected", "observed", "words"),
    [
        ({"axis": ["FAULT"], "reaction_ms": 20, "torque_gone_ms": 30}, seen(), ""),
        ({"axis": ["ENABLED"]}, seen(), "the axis ended FAULT"),
        ({"axis": ["FAULT"], "faults": ["BUS_OFF"]}, seen(), "the faults shown are FEEDBACK_STALE"),
        ({"axis": ["FAULT"], "faults": ["BUS_OFF", "FEEDBACK_STALE"]}, seen(), ""),
        ({"axis": ["FAULT"], "reaction_ms": 19}, seen(), "after 20 ms, expected 19 ms"),
        ({"axis": ["FAULT"], "torque_gone_ms": 29}, seen(), "the torque was gone after 30 ms"),
        ({"axis": ["FAULT"], "torque_gone_ms": 300}, seen(RUNAWAY), "the torque was gone never"),
        ({"axis": ["FAULT"]}, seen(RUNAWAY), "0.1000 N*m that nobody commands"),
        ({"axis": ["ENABLED"]}, seen(HELD, axis="ENABLED"), ""),
        ({"axis": ["ENABLED"], "most_nm": 0.1}, seen(HELD, axis="ENABLED"), ""),
        ({"axis": ["ENABLED"], "most_nm": 0.09}, seen(HELD, axis="ENABLED"), "felt 0.100 N*m, expected 0.09"),
        ({"axis": ["FAULT"]}, seen(refusal="not now"), "refused: not now"),
        ({"axis": ["FAULT"], "refused": "two"}, seen(refusal="not now"), "the refusal says 'not now'"),
        ({"axis": ["FAULT"]}, seen(lost=1), "1 cycle records are missing"),
        ({"axis": ["FAULT"], "drive_shows": ["QUICK_STOP_ACTIVE"]}, seen(), "never showed QUICK_STOP_ACTIVE"),
        ({"axis": ["FAULT"], "drive_never": ["SWITCH_ON_DISABLED"]}, seen(), "showed SWITCH_ON_DISABLED"),
        ({"axis": ["FAULT"], "says": "ONE_WAY"}, seen(says=WiringOutcome.ONE_WAY), ""),
        (
            {"axis": ["FAULT"], "says": "ONE_WAY"},
            seen(says=WiringOutcome.NO_MOTION),
            "says NO_MOTION, expected ONE_WAY",
        ),
        ({"axis": ["FAULT"], "says": "ONE_WAY"}, seen(), "says nothing, expected ONE_WAY"),
        ({"axis": ["FAULT"], "drive_error": 0x2320}, seen(errors=(0x2320,)), ""),
        ({"axis": ["FAULT"], "drive_error": 0x2320}, seen(errors=(0x2310,)), "shown are 0x2310, expected 0x2320"),
        ({"axis": ["FAULT"], "drive_error": 0x2320}, seen(), "shown are none, expected 0x2320"),
    ],
)
def test_each_difference_is_a_complaint(expected: dict, observed: Observation, words: str) -> None:
    head = {"title": "x", "why": "x", "group": "x", "start": "off", "inject": [{"do": {"tell": {"op": "disable"}}}]}
    scenario = Scenario.model_validate({**head, "expect": expected})
    times, watch = reaction(observed.samples, 0), Watch(0, observed.samples[-1].time_ns)
    found = complaints(scenario, observed, times, watch)
    assert bool(found) is bool(words)
    assert words in " ".join(found)
