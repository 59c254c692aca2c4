"""Runs one scenario on its axis under test and says how it ended."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from servod.campaign.actions import action_of
from servod.campaign.judge import Reaction, complaints, reaction
from servod.campaign.processes import ProcessAxis
from servod.campaign.scenario import Loss, Recovery, Runs, Scenario
from servod.campaign.stepped import SteppedAxis
from servod.campaign.under_test import AxisUnderTest
from servod.errors import FAULTS, Unreachable


@dataclass(frozen=True)
class Outcome:
    """How a scenario ended; it passed when there are no complaints."""

    name: str
    title: str
    group: str
    injected: str
    detected: tuple[str, ...]
    remedy: str
    axis: str
    reaction: Reaction
    lost_records: int
    recovered: bool
    complaints: tuple[str, ...]
    loss: Loss

    @property
    def passed(self) -> bool:
        """True when everything was as expected."""
        return not self.complaints


def axis_of(scenario: Scenario, folder: Path) -> AxisUnderTest:
    """The axis under test that the scenario names. Raises BadInput for its keys, Unreachable for one of the guest."""
    if scenario.runs is Runs.GUEST:
        raise Unreachable(f"{scenario.title}: needs the guest machine (scripts/guest)")
    return SteppedAxis(scenario, folder) if scenario.runs is Runs.STEPPED else ProcessAxis(scenario, folder)


def run_scenario(
    name: str, scenario: Scenario, axis_for: Callable[[Scenario, Path], AxisUnderTest] = axis_of
) -> Outcome:
    """Start, inject, watch, judge, recover. Raises ServodError when the axis does not get to the start."""
    with (
        tempfile.TemporaryDirectory(prefix="servod-faults-") as folder,
        contextlib.closing(axis_for(scenario, Path(folder))) as axis,
    ):
        axis.start(scenario.start)
        injected_ns = _inject(axis, scenario)
        axis.run(scenario.watch_ms / 1e3)
        seen = axis.observe()
        times = reaction(seen.samples, injected_ns)
        found = complaints(scenario.expect, seen, times, injected_ns)
        recovered = scenario.recover is not Recovery.REPAIR and axis.recover(scenario.recover)
    if not recovered and scenario.recover is not Recovery.REPAIR:
        found.append(f"the axis was not enabled again by {scenario.recover}")
    codes = sorted(seen.latched)
    return Outcome(
        name,
        scenario.title,
        scenario.group,
        ", ".join(i.action for i in scenario.inject),
        tuple(code.name for code in codes),
        " ".join(FAULTS[code].remedy for code in codes) or seen.refusal,
        seen.axis,
        times,
        seen.lost_records,
        recovered,
        tuple(found),
        scenario.expect.loss,
    )


def _inject(axis: AxisUnderTest, scenario: Scenario) -> int:
    """Apply every injection at its time; returns the time of the first [ns]."""
    started_ns = axis.now_ns()
    first_ns = 0
    for number, injection in enumerate(sorted(scenario.inject, key=lambda i: i.at_ms)):
        wait_s = (started_ns - axis.now_ns()) / 1e9 + injection.at_ms / 1e3
        if wait_s > 0.0:
            axis.run(wait_s)
        first_ns = first_ns or axis.now_ns()
        action_of(injection, f"{scenario.title}: inject.{number}", scenario.runs).apply(axis)
    return first_ns
