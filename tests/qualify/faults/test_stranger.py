"""Effects of a stranger on the bus of a virtual axis that is a process: by the wire and by the hub's own count."""

from collections.abc import Iterator
from typing import Any

import pytest

from servod.common.errors import BadInput
from servod.drivers.virtual.bus_faults import BusFault, FaultKind
from servod.drivers.virtual.client import VirtualBus
from servod.qualify.faults.actions import InjectionAction, action_of
from servod.qualify.faults.processes import ProcessAxis
from servod.qualify.faults.scenario import Injection, Runs, Scenario, ScenarioStart

NMT = {"nmt": {"who": "encoder", "command": "pre_operational"}}
SCENARIO = {
    "title": "x",
    "why": "x",
    "group": "x",
    "runs": "processes",
    "start": "off",
    "expect": {"axis": ["DISABLED"]},
}


def action(do: dict[str, Any]) -> InjectionAction:
    return action_of(Injection(do=do), "x", Runs.PROCESSES)


@pytest.fixture(scope="module")
def axis(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ProcessAxis]:
    scenario = Scenario.model_validate({**SCENARIO, "inject": [{"do": NMT}]})
    axis = ProcessAxis(scenario, tmp_path_factory.mktemp("axis"))
    axis.start(ScenarioStart.OFF)
    yield axis
    axis.close()


def written(index: int, subindex: int, value: int) -> dict[str, Any]:
    return {"object_write": {"who": "encoder", "index": index, "subindex": subindex, "value": value}}


@pytest.mark.parametrize(
    ("do", "times"),
    [
        (NMT, 1),
        ({"foreign_frame": {"can_id": 0x123, "data": "0102"}}, 1),
        (written(0x2000, 5, 3), 1),
        (written(0x1018, 1, 77), 0),  # who made it is not for writing
        ({"silence": {"who": "encoder", "for_ms": 1}}, 0),  # nobody talks to it in this time
        ({"bus_off": {"who": "amplifier"}}, 1),
    ],
)
def test_what_came_of_an_action_is_known(axis: ProcessAxis, do: dict[str, Any], times: int) -> None:
    tried = action(do)
    before = tried.effect(axis)
    tried.apply(axis)
    assert tried.effect(axis) - before == times


def test_a_frame_that_the_hub_drops_is_struck_and_not_heard(axis: ProcessAxis) -> None:
    drop, frame = (
        action({"frames": {"of": "sync", "fault": "drop", "count": 1}}),
        action({"foreign_frame": {"can_id": 128}}),
    )
    assert drop.effect(axis) == frame.effect(axis) == 0
    for tried in (drop, frame):
        tried.apply(axis)
    assert (drop.effect(axis), frame.effect(axis)) == (1, 0)
    frame.apply(axis)
    assert (drop.effect(axis), frame.effect(axis)) == (1, 1)


def test_what_only_the_loop_could_ask_for_is_refused(axis: ProcessAxis) -> None:
    with pytest.raises(BadInput, match="another participant"):
        action({"silence": {"who": "loop", "for_ms": 1}}).apply(axis)


def test_a_question_without_sense_is_answered_with_none(axis: ProcessAxis) -> None:
    foreign = axis.wire.foreign()
    assert isinstance(foreign, VirtualBus)
    foreign.inject(BusFault(FaultKind.HAPPENED, amount=250))
    assert foreign.happened(BusFault(FaultKind.NONE)) == 0
    foreign.close()
