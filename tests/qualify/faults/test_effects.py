"""A fault that did not happen proves nothing: each scenario whose injections do nothing fails for that."""

from pathlib import Path
from typing import Any

import pytest

from servod.qualify.faults import run
from servod.qualify.faults.actions import InjectionAction, action_of
from servod.qualify.faults.run import Effects
from servod.qualify.faults.scenario import Injection, Runs, Scenario
from servod.qualify.faults.stepped import SteppedUnderTest
from servod.qualify.faults.variants import shipped_scenarios

#: One of each kind of trace; all of these end ENABLED, so that nothing else would tell.
KINDS = (
    ("disturbed/5 torque", "no frame was struck"),
    ("torque_frames_hurt/5 with a wrong torque bit", "no frame was struck"),
    ("cut_off_for_a_while/encoder 10 ms", "no frame was lost"),
    ("queue_full/10 ms", "no frame had to wait"),
    ("flood/a quarter of the bus", "no frame of the babbler was carried"),
    ("wakes_late/SYNC jitter of 0.3 ms", "the loop was never woken late"),
    ("alarm/warning", "the node did not take the value"),
    ("wraps/one turn", "the counter never wrapped"),
)


@pytest.mark.parametrize(("name", "trace"), KINDS)
def test_an_injection_that_does_nothing_is_found(name: str, trace: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run, "_inject", lambda axis, *_: axis.now_ns())
    outcome = run.run_scenario(name, shipped_scenarios()[name])
    assert f"the fault did not happen: {trace}" in outcome.complaints
    assert outcome.axis == "ENABLED"


def scenario(*do: dict[str, Any]) -> Scenario:
    data = {"title": "x", "why": "x", "group": "x", "start": "off", "inject": [{"do": action} for action in do]}
    return Scenario.model_validate({**data, "expect": {"axis": ["DISABLED"]}})


def frames(fault: str, count: int | None = None, detail: int = 0) -> dict[str, Any]:
    return {"frames": {"of": "amplifier_heartbeat", "fault": fault, "count": count, "detail": detail}}


def told(folder: Path, injected: Scenario, applied: Scenario) -> list[str]:
    """Complaints after `applied` where `injected` should have been, with a quarter of a second on the bus."""
    axis = SteppedUnderTest(injected, folder)
    effects = Effects(injected, axis)
    for injection in applied.inject:
        action_of(injection, "x", Runs.STEPPED).apply(axis)
    axis.run(0.25)
    axis.close()
    return list(effects.complaints())


NMT = {"nmt": {"who": "encoder", "command": "stop"}}
WRITE = {"object_write": {"who": "encoder", "index": 0x2000, "subindex": 5, "value": 3}}
OTHER = {"object_write": {"who": "encoder", "index": 0x2000, "subindex": 4, "value": 3}}
TWIN = {"second_node": {"who": "encoder"}}
FRAME = {"foreign_frame": {"can_id": 0x7FF}}
BUS_OFF = {"bus_off": {"who": "encoder"}}


@pytest.mark.parametrize(
    ("injected", "applied", "words"),
    [
        ([frames("drop", 2)], [frames("drop", 2)], ""),
        ([frames("drop", 50)], [frames("drop", 50)], "no frame was struck ("),
        ([frames("late", 1, 3)], [frames("late", 1, 3)], ""),
        ([frames("late", 1)], [frames("late", 1)], "no frame was struck"),
        ([frames("shorten", 1)], [frames("shorten", 1)], "no frame was struck"),
        ([frames("drop")], [frames("duplicate")], "no frame was struck"),
        ([frames("drop"), {"frames_pass": {}}], [frames("drop"), {"frames_pass": {}}], "no frame was struck"),
        ([NMT], [NMT], ""),
        ([NMT], [{"nmt": {"who": "amplifier", "command": "stop"}}], "nobody heard the frame"),
        ([WRITE, OTHER], [WRITE, OTHER], ""),
        ([WRITE, OTHER], [WRITE], "the node did not take the value"),
        ([TWIN], [TWIN], ""),
        ([TWIN], [], "the second node sent nothing"),
        ([FRAME], [FRAME], ""),
        ([FRAME], [], "nobody heard the frame"),
        ([BUS_OFF], [BUS_OFF], ""),
        ([BUS_OFF, BUS_OFF], [BUS_OFF, BUS_OFF], "no controller went bus-off (1 of 2 times)"),
    ],
)
def test_each_effect_is_known_by_its_trace(
    injected: list[dict[str, Any]], applied: list[dict[str, Any]], words: str, tmp_path: Path
) -> None:
    found = told(tmp_path, scenario(*injected), scenario(*applied) if applied else scenario(frames("duplicate", 1)))
    assert bool(found) is bool(words)
    assert words in " ".join(found)


def test_every_action_that_ships_has_a_trace_of_its_own() -> None:
    """No two kinds of action are counted by one mark, and no scenario injects what cannot be counted."""
    owners: dict[object, type[InjectionAction]] = {}
    for name, shipped in shipped_scenarios().items():
        for injection in (*shipped.inject, *shipped.mend):
            action = action_of(Injection(do=injection.do), name, shipped.runs)
            assert owners.setdefault(action.mark(), type(action)) is type(action)
            assert action.wanted() >= 1
