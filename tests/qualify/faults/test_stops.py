"""Stops are held against what was stated: by the judge on records made by hand, and on axes drawn at random."""

from __future__ import annotations

from typing import Any

import pytest

from servod.drivers.virtual.drive_record import DriveSample
from servod.qualify.faults.chance import drawn
from servod.qualify.faults.run import outcome_of
from servod.qualify.faults.scenario import Loss, Scenario
from servod.qualify.faults.stops import stop_complaints
from servod.runtime.fieldbus.devices import DriveState

MS = 1_000_000
ON, STOPS, OFF = DriveState.OPERATION_ENABLED, DriveState.QUICK_STOP_ACTIVE, DriveState.SWITCH_ON_DISABLED
STATED: dict[str, Any] = {
    "time_s": 0.05,
    "speed_rad_s": 3.6,
    "travel_rad": 0.12,
    "unbraked_rad": 0.1,
    "coasts_rad": 0.4,
}
STATED["deceleration_rad_s2"] = 100.0
COASTS = "the drive cannot brake any more"


def sample(time_ms: float, state: DriveState, torque_nm: float, position_rad: float, speed_rad_s: float) -> DriveSample:
    return DriveSample(round(time_ms * MS), state, 0, 0, 10, torque_nm, torque_nm, position_rad, speed_rad_s)


def braked(
    gone_ms: float = 45.0, fastest_rad_s: float = 3.5, travel_rad: float = 0.11, after_rad: float = 0.0
) -> list[DriveSample]:
    return [
        sample(-1, ON, 0.1, 1.0, 3.0),
        sample(0, ON, 0.1, 1.0, 3.0),
        sample(20, STOPS, -0.3, 1.05, fastest_rad_s),
        sample(gone_ms, OFF, 0.0, 1.0 + travel_rad, 0.02),
        sample(500, OFF, 0.0, 1.0 + travel_rad + after_rad, 0.0),
    ]


def coasting(travel_rad: float) -> list[DriveSample]:
    return [
        sample(-1, ON, 0.1, 1.0, 3.0),
        sample(5, OFF, 0.0, 1.015, 3.0),
        sample(900, OFF, 0.0, 1.0 + travel_rad, 0.0),
    ]


@pytest.mark.parametrize(
    ("samples", "stated", "words"),
    [
        (braked(), {}, ""),
        (braked(gone_ms=53.0), {}, "the torque was gone after 53 ms, stated were 50 ms"),
        (braked(fastest_rad_s=-3.7), {}, "the joint turned at 3.70 rad/s, stated were 3.60 rad/s"),
        (braked(travel_rad=-0.13), {}, "the joint went 0.130 rad until it rested, stated were 0.120 rad"),
        (braked(after_rad=0.02), {}, "the joint went 0.130 rad"),
        (braked(after_rad=5.0), {"coasts_rad": None}, ""),  # a load takes it away when the torque is gone
        (braked()[:-2], {}, "the torque was never gone"),
        (coasting(0.11), {}, "the torque was gone at 3.00 rad/s: no ramp brought the joint to rest"),
        (coasting(0.39), {}, "the joint went 0.390 rad until it rested, stated were 0.120 rad"),
        (coasting(0.39), {"deceleration_rad_s2": 0.0}, ""),  # no ramp was ever stated
        (
            coasting(0.41),
            {"deceleration_rad_s2": 0.0},
            "the joint went 0.410 rad until it rested, stated were 0.400 rad",
        ),
    ],
)
def test_the_judge_reads_time_speed_and_way_off_the_record(
    samples: list[DriveSample], stated: dict[str, Any], words: str
) -> None:
    scenario = braking()
    found = list(stop_complaints(scenario, Loss.MASTER, samples, 0, STATED | stated))
    assert bool(found) is bool(words)
    assert words in "; ".join(found)


def braking(coasts: str | None = None) -> Scenario:
    """A scenario whose stop has a ramp, unless it says why not."""
    scenario = drawn(1, 1)["random/1"]
    return scenario.model_copy(update={"expect": scenario.expect.model_copy(update={"coasts": coasts})})


@pytest.mark.parametrize(
    ("samples", "stated", "words"),
    [
        (coasting(0.39), {}, ""),
        (coasting(0.41), {}, "the joint went 0.410 rad until it rested, stated were 0.400 rad"),
        (coasting(9.0), {"coasts_rad": None}, ""),
        (coasting(9.0), {"coasts_rad": None, "unbraked_rad": 0.01}, "went 0.015 rad"),
    ],
)
def test_only_a_scenario_that_says_why_may_coast(
    samples: list[DriveSample], stated: dict[str, Any], words: str
) -> None:
    found = list(stop_complaints(braking(COASTS), Loss.MASTER, samples, 0, STATED | stated))
    assert bool(found) is bool(words)
    assert words in "; ".join(found)


def test_a_fault_that_disables_is_no_reason_to_coast() -> None:
    """Which stops end without a ramp is written with each of them: a derived exemption hid those that lost theirs."""
    scenario = braking()
    lost = scenario.expect.model_copy(update={"faults": ["COMMANDS_LOST", "LOOP_LOST", "ENCODER_ALARM"]})
    words = "; ".join(
        stop_complaints(scenario.model_copy(update={"expect": lost}), Loss.MASTER, coasting(0.39), 0, STATED)
    )
    assert "no ramp brought the joint to rest" in words


def test_a_stop_that_comes_later_counts_from_where_the_drive_reacts() -> None:
    scenario = braking()
    late = [sample(-500, ON, 0.1, 0.0, 3.0), sample(-300, ON, 0.1, 0.6, 3.0), *braked()[1:]]
    assert "rad until it rested" in "; ".join(stop_complaints(scenario, Loss.MASTER, late, -400 * MS, STATED))
    assert not list(stop_complaints(scenario, Loss.NONE, late, -400 * MS, STATED))


def test_the_same_seed_draws_the_same_and_every_kind_of_joint() -> None:
    first = drawn(60, 4)
    assert first == drawn(60, 4) != drawn(60, 5)
    titles = "; ".join(scenario.title for scenario in first.values())
    for word in ("light", "heavy", "hanging", "forward", "backward", "at peak", "at top", "running away", "alone"):
        assert word in titles


def test_commands_alone_lost_are_drawn_for_a_drive_that_does_not_watch_them_too() -> None:
    """Nothing is stated of how far that goes; that it stops is held against a bound."""
    unwatched = [s for s in drawn(600, 1).values() if s.title.startswith("commands lost") and "alone" in s.title]
    assert unwatched
    assert all(s.settings["command_deadline"] == "none" and s.expect.unstated for s in unwatched)
    outcome = outcome_of("unwatched", unwatched[0])
    assert outcome.passed, outcome.complaints


DIES = {"dies": {"who": ["loop", "supervisor"]}}


@pytest.mark.parametrize("number", range(1, 25))
def test_random_stops_keep_what_was_stated(number: int) -> None:
    name = f"random/{number}"
    outcome = outcome_of(name, drawn(24, 9)[name])
    assert outcome.passed, outcome.complaints


def test_an_axis_that_its_load_drives_away_meets_its_failure_before_its_limits() -> None:
    """A hanging joint that runs away downwards is stopped by its position limit within some 35 ms."""
    name = "random/155"
    outcome = outcome_of(name, drawn(155, 94)[name])
    assert outcome.passed, outcome.complaints


@pytest.mark.parametrize("number", [35, 90, 114])
def test_a_dead_loop_has_no_leave_to_coast(number: int) -> None:
    """The supervisor has the drive brake, and so it is held against what was stated of that."""
    name = f"random/{number}"
    scenario = drawn(114, 11)[name]
    assert scenario.title.startswith("loop dies") and not scenario.expect.coasts
    outcome = outcome_of(name, scenario)
    assert outcome.passed, outcome.complaints


def test_peak_torque_on_a_light_joint_whose_master_dies() -> None:
    """A step of 0.14 rad with 0.3 N*m where 3 rad/s are allowed: 29 rad/s and 7 rad, where nothing is reckoned."""
    titled = (s for s in drawn(60, 4).values() if s.title.startswith("loop dies") and "light joint" in s.title)
    drawn_one = next(s for s in titled if "heartbeat alone" in s.title)
    inject = [
        {"do": {"gains": {"law": "pd", "parameters": [20.0, 0.05, 0.0]}}},
        {"at_ms": 10.0, "do": {"step": {"amplitude_rad": 0.14}}},
        {"at_ms": 22.0, "do": DIES, "timed": True},
    ]
    data = drawn_one.model_dump(mode="json", exclude_none=True) | {"inject": inject}
    known = outcome_of("known", Scenario.model_validate(data))
    assert known.passed, known.complaints
    assert known.stop is not None
    assert known.stop.fastest_rad_s <= 3.6
    data["config"] = {key: value for key, value in data["config"].items() if key != "stopping"}
    unstated = outcome_of("unstated", Scenario.model_validate(data))
    assert unstated.stated is not None, "the campaign states the scenario's own joint"
    assert unstated.passed, unstated.complaints
