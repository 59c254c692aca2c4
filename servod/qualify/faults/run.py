"""Runs one scenario on its axis under test and says how it ended."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from servod.common.errors import FAULTS, Unreachable
from servod.qualify.faults.actions import action_of
from servod.qualify.faults.effects import Effects
from servod.qualify.faults.evidence import Watch
from servod.qualify.faults.judge import Reaction, complaints, reaction
from servod.qualify.faults.losses import loss_of
from servod.qualify.faults.processes import ProcessAxis
from servod.qualify.faults.scenario import Injection, Loss, Recovery, Runs, Scenario
from servod.qualify.faults.stepped import SteppedAxis
from servod.qualify.faults.under_test import AxisUnderTest, Observation


@dataclass(frozen=True)
class Outcome:
    """How a scenario ended; it passed when there are no complaints.

    `loss` is what its actions take from the axis, `exempt` why that loss has another bound than all others.
    """

    name: str
    title: str
    group: str
    injected: str
    detected: tuple[str, ...]
    remedy: str
    axis: str
    reaction: Reaction
    lost_records: int | None
    recovered: bool
    complaints: tuple[str, ...]
    loss: Loss
    exempt: str | None = None
    by_repair: bool = False  # nothing but a repair was to bring it back

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
    """Start, inject, watch, judge, mend, recover. Raises ServodError when the axis does not get to the start."""
    with (
        tempfile.TemporaryDirectory(prefix="servod-faults-") as folder,
        contextlib.closing(axis_for(scenario, Path(folder))) as axis,
    ):
        axis.start(scenario.start)
        effects = Effects(scenario, axis)
        injected_ns = _inject(axis, scenario, scenario.inject)
        axis.run(scenario.watch_ms / 1e3)
        watch = Watch(injected_ns, axis.now_ns())
        seen = axis.observe()
        times = reaction(seen.samples, injected_ns)
        found = [*effects.complaints(), *complaints(scenario, seen, times, watch)]
        recovered = scenario.recover is not Recovery.REPAIR and _recover(axis, scenario)
    if not recovered and scenario.recover is not Recovery.REPAIR:
        found.append(f"the axis was not enabled again by {scenario.recover}")
    return _outcome(name, scenario, seen, times, recovered, found)


def _outcome(
    name: str, scenario: Scenario, seen: Observation, times: Reaction, recovered: bool, found: list[str]
) -> Outcome:
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
        loss_of(scenario),
        scenario.expect.exempt,
        scenario.recover is Recovery.REPAIR,
    )


def _recover(axis: AxisUnderTest, scenario: Scenario) -> bool:
    """Take the cause away, where it does not go by itself, and do what the fault's remedy says."""
    _inject(axis, scenario, scenario.mend)
    axis.run(scenario.mend_ms / 1e3)
    return axis.recover(scenario.recover)


def _inject(axis: AxisUnderTest, scenario: Scenario, injections: Sequence[Injection]) -> int:
    """Apply every injection at its time; returns the time [ns] of the timed one, or of the first."""
    started_ns = axis.now_ns()
    counted_ns = started_ns
    for number, injection in enumerate(sorted(injections, key=lambda i: i.at_ms)):
        wait_s = (started_ns - axis.now_ns()) / 1e9 + injection.at_ms / 1e3
        if wait_s > 0.0:
            axis.run(wait_s)
        if injection.timed or number == 0:
            counted_ns = axis.now_ns()
        action_of(injection, f"{scenario.title}: inject.{number}", scenario.runs).apply(axis)
    return counted_ns
