"""What an action takes from the axis is its own word, whatever the scenario's file expects."""

import json
from typing import Any

import pytest

from servod.common.errors import BadInput
from servod.qualify.faults.judge import ReactionTimes, check_bounds, loss_of
from servod.qualify.faults.run import Outcome, document, summary
from servod.qualify.faults.scenario import Loss, Scenario

NONE, FEEDBACK, MASTER = Loss


def scenario(do: dict[str, Any], runs: str = "stepped", start: str = "moving", **expected: Any) -> Scenario:
    data = {"title": "x", "why": "x", "group": "x", "runs": runs, "start": start, "inject": [{"do": do}]}
    return Scenario.model_validate({**data, "expect": {"axis": ["FAULT"], "torque_gone_ms": 9000, **expected}})


def frames(of: str, fault: str, count: int | None = None) -> dict[str, Any]:
    return {"frames": {"of": of, "fault": fault, "count": count}}


def process(who: list[str], signal: str) -> dict[str, Any]:
    return {"signal": {"who": who, "signal": signal}}


@pytest.mark.parametrize(
    ("do", "loss"),
    [
        (frames("encoder_feedback", "drop", 20), NONE),
        (frames("encoder_feedback", "drop", 21), FEEDBACK),
        (frames("encoder_feedback", "shorten"), FEEDBACK),
        (frames("encoder_feedback", "late"), NONE),
        (frames("torque", "drop", 50), NONE),
        (frames("torque", "drop"), MASTER),
        (frames("torque", "destroy", 31), NONE),
        (frames("torque", "destroy", 32), MASTER),
        (frames("amplifier_heartbeat", "drop"), NONE),
        (frames("master_heartbeat", "drop"), MASTER),
        ({"silence": {"who": "encoder", "for_ms": 20}}, NONE),
        ({"silence": {"who": "encoder", "for_ms": 21}}, FEEDBACK),
        ({"silence": {"who": "amplifier", "for_ms": 51}}, MASTER),
        ({"bus_off": {"who": "loop"}}, MASTER),
        ({"bus_off": {"who": "encoder"}}, FEEDBACK),
        ({"queue_stands": {"who": "loop", "for_ms": 500}}, MASTER),
        ({"interface_down": {"for_ms": 5}}, MASTER),
        ({"babble": {"can_id": 1, "for_ms": 400}}, MASTER),
        ({"babble": {"can_id": 1, "for_ms": 400, "each_ms": 2}}, NONE),
        ({"babble": {"can_id": 0x7FF, "for_ms": 400}}, NONE),
        ({"nmt": {"who": "encoder", "command": "stop"}}, FEEDBACK),
        ({"nmt": {"who": "encoder", "command": "start"}}, NONE),
        ({"object_write": {"who": "encoder", "index": 0x2000, "subindex": 3, "value": 1}}, FEEDBACK),
        ({"object_write": {"who": "encoder", "index": 0x2000, "subindex": 3, "value": 0}}, NONE),
        ({"object_write": {"who": "amplifier", "index": 0x2000, "subindex": 4, "value": 1}}, MASTER),
        ({"wakes_late": {"most_us": 200_000, "times": 1}}, MASTER),
        ({"wakes_late": {"most_us": 2500, "exactly": True}}, MASTER),
        ({"wakes_late": {"most_us": 1500, "exactly": True, "one_in": 100}}, NONE),
    ],
)
def test_each_action_says_what_it_takes(do: dict[str, Any], loss: Loss) -> None:
    assert loss_of(scenario(do)) is loss


@pytest.mark.parametrize(
    ("do", "runs", "loss"),
    [
        (process(["loop"], "SIGSTOP"), "processes", MASTER),
        (process(["daemon"], "SIGSTOP"), "processes", NONE),
        (process(["daemon"], "SIGKILL"), "processes", MASTER),
        (process(["virtual_axis"], "SIGSTOP"), "processes", FEEDBACK),
        (process(["virtual_axis"], "SIGCONT"), "processes", NONE),
        ({"cpu_load": {"busy_ms": 20, "idle_ms": 10, "for_ms": 100}}, "processes", MASTER),
        ({"cpu_load": {"busy_ms": 1, "idle_ms": 10, "for_ms": 100}}, "processes", NONE),
        ({"interface": {"do": "gone"}}, "guest", MASTER),
        ({"interface": {"do": "back"}}, "guest", NONE),
        ({"cansend": {"frame": "000#0201"}}, "guest", FEEDBACK),
        ({"cansend": {"frame": "701#00"}}, "guest", NONE),
    ],
)
def test_processes_and_the_guest_are_held_to_it_too(do: dict[str, Any], runs: str, loss: Loss) -> None:
    assert loss_of(scenario(do, runs)) is loss


def test_an_axis_without_power_has_nothing_to_lose() -> None:
    assert loss_of(scenario({"bus_off": {"who": "loop"}}, start="disabled")) is NONE


def test_a_loss_without_its_bound_is_refused_unless_the_file_says_why() -> None:
    do = frames("encoder_feedback", "drop")
    for expected in ({}, {"reaction_ms": 51}):
        with pytest.raises(BadInput, match="reaction_ms of at most 50 after a loss of feedback"):
            check_bounds(scenario(do, **expected), "x.yaml")
    check_bounds(scenario(do, reaction_ms=50), "x.yaml")
    check_bounds(scenario(do, exempt="nobody can tell it from rest"), "x.yaml")


def outcome(name: str, gone_ms: float, exempt: str | None) -> Outcome:
    times = ReactionTimes(gone_ms, gone_ms)
    return Outcome(
        name, "x", "x", "x", (), "", "FAULT", times, 0, exempt is None, (), MASTER, exempt, exempt is not None
    )


def test_exemptions_are_counted_and_shown_and_leave_the_times_alone() -> None:
    found = [outcome("a/1", 100.0, None), outcome("a/2", 900.0, "the guest is slow"), outcome("b", 50.0, None)]
    told = json.loads(json.dumps(document(found, 3)))
    assert told["worst"]["master"] == {"scenarios": 2, "exempt": 1, "left_ms": 100.0, "gone_ms": 100.0}
    assert told["scenarios"][1]["exempt"] == "the guest is slow"
    text = summary(found, 3)
    assert text[0] == "3 of 3 scenarios in 2 files passed."
    assert "Exempt from the bound: a/2: the guest is slow." in text
    assert "Recovered: 2; 1 need repair at the hardware." in text
