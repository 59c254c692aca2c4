"""Runs one scenario on its axis under test and says how it ended."""

from __future__ import annotations

import contextlib
import multiprocessing
import signal
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

from servod.client.processes import socket_folder
from servod.common.errors import ServodError, Unreachable
from servod.common.faults import FAULTS
from servod.common.units import counted
from servod.formats.stopping import StoppingStatus
from servod.qualify.faults.actions import InjectionAction, action_of
from servod.qualify.faults.evidence import Watch
from servod.qualify.faults.judge import ReactionTimes, complaints, loss_of, reaction
from servod.qualify.faults.processes import ProcessAxis
from servod.qualify.faults.scenario import Injection, Loss, Recovery, Runs, Scenario
from servod.qualify.faults.stepped import SteppedUnderTest
from servod.qualify.faults.stops import StopSeen, stop_of, stopped_by
from servod.qualify.faults.under_test import AxisUnderTest, Observation

if TYPE_CHECKING:
    from servod.lab.report.page import Page

# --- What really happened --------------------------------------------------------------------------------------------
# Whether what a scenario injects really happened: a fault that hits nothing proves nothing. Part of the judge. Each
# action knows its trace: frames that the hub struck, a node that took a value, a process that got its signal. Beside
# the injection on purpose: an injection that does nothing cannot say that it did.


class Effects:
    """Counts the effects of a scenario's injections on `axis`, from the moment at which this is made."""

    def __init__(self, scenario: Scenario, axis: AxisUnderTest) -> None:
        self._axis = axis
        self._actions: dict[Hashable, list[InjectionAction]] = {}
        for injection in scenario.inject:
            action = action_of(injection, scenario.title, scenario.runs)
            self._actions.setdefault(action.mark(), []).append(action)
        self._before = {mark: actions[0].effect(axis) for mark, actions in self._actions.items()}

    def complaints(self) -> Iterator[str]:
        """What did not happen, or not as often as it should have."""
        for mark, actions in self._actions.items():
            wanted = sum(action.wanted() for action in actions)
            seen = actions[0].effect(self._axis) - self._before[mark]
            if seen < wanted:
                often = "" if not seen else f" ({seen} of {wanted} times)"
                yield f"the fault did not happen: {actions[0].traceless}{often}"


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
    reaction: ReactionTimes
    lost_records: int | None
    recovered: bool
    complaints: tuple[str, ...]
    loss: Loss
    exempt: str | None = None
    by_repair: bool = False  # nothing but a repair was to bring it back
    stop: StopSeen | None = None  # of an axis that was stopped
    stated: StoppingStatus | None = None  # time_s, speed_rad_s, travel_rad and more, as servod has them

    @property
    def passed(self) -> bool:
        """True when everything was as expected."""
        return not self.complaints


def axis_of(scenario: Scenario, folder: Path) -> AxisUnderTest:
    """The axis under test that the scenario names. Raises BadInput for its keys, Unreachable for one of the guest."""
    if scenario.runs is Runs.GUEST:
        raise Unreachable(f"{scenario.title}: needs the guest machine (scripts/guest)")
    return SteppedUnderTest(scenario, folder) if scenario.runs is Runs.STEPPED else ProcessAxis(scenario, folder)


def run_scenario(
    name: str, scenario: Scenario, axis_for: Callable[[Scenario, Path], AxisUnderTest] = axis_of
) -> Outcome:
    """Start, inject, watch, judge, mend, recover. Raises ServodError when the axis does not get to the start."""
    with (
        socket_folder("servod-faults-") as folder,
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
    return _outcome(name, scenario, seen, injected_ns, times, recovered, found)


def _outcome(
    name: str,
    scenario: Scenario,
    seen: Observation,
    injected_ns: int,
    times: ReactionTimes,
    recovered: bool,
    found: list[str],
) -> Outcome:
    stop = stop_of(seen.samples, injected_ns) if stopped_by(scenario) else None
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
        stop,
        seen.stated,
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


# --- The campaign ----------------------------------------------------------------------------------------------------
# The whole campaign: scenarios one after the other, or several of those in virtual time at once. Whoever takes the
# outcomes may stop in between and keeps what came so far.


Scenarios = Mapping[str, Scenario]


def outcomes(scenarios: Scenarios, jobs: int = 1) -> Iterator[Outcome]:
    """Each outcome as it comes: first those in virtual time, `jobs` at once, then those on the wall clock one by one.

    Those of the guest machine are left out: its own script runs them.
    """
    stepped = {name: s for name, s in scenarios.items() if s.runs is Runs.STEPPED}
    if jobs > 1:
        yield from _at_once(stepped, jobs)
    else:
        yield from (outcome_of(name, scenario) for name, scenario in stepped.items())
    yield from (outcome_of(name, s) for name, s in scenarios.items() if s.runs is Runs.PROCESSES)


def outcome_of(name: str, scenario: Scenario) -> Outcome:
    """How the scenario ended; one whose axis did not get to the start, or that broke off, has failed for that."""
    try:
        return run_scenario(name, scenario)
    except ServodError as error:
        return _unfinished(name, scenario, "not started", str(error))
    except Exception as error:  # a mistake of ours: the other scenarios and the report are not lost for it
        return _broken_off(name, scenario, error)


def _broken_off(name: str, scenario: Scenario, error: BaseException) -> Outcome:
    why = " ".join(f"{type(error).__name__}: {error}".split())
    return _unfinished(name, scenario, "broken off", why)


def _unfinished(name: str, scenario: Scenario, axis: str, why: str) -> Outcome:
    injected = ", ".join(i.action for i in scenario.inject)
    nothing = ReactionTimes(None, None)
    return Outcome(
        name,
        scenario.title,
        scenario.group,
        injected,
        (),
        "",
        axis,
        nothing,
        None,
        False,
        (why,),
        loss_of(scenario),
        scenario.expect.exempt,
    )


def _at_once(scenarios: Scenarios, jobs: int) -> Iterator[Outcome]:
    """In processes of their own; what has not begun when the taker stops never begins."""
    pool = ProcessPoolExecutor(
        jobs,
        mp_context=multiprocessing.get_context("spawn"),
        initializer=signal.signal,
        initargs=(signal.SIGINT, signal.SIG_IGN),  # Ctrl-C is for the one who takes the outcomes
    )
    with contextlib.ExitStack() as stack:
        stack.callback(pool.shutdown, wait=True, cancel_futures=True)
        running = {pool.submit(outcome_of, name, scenario): name for name, scenario in scenarios.items()}
        for done in as_completed(running):
            died, name = done.exception(), running[done]
            yield done.result() if died is None else _broken_off(name, scenarios[name], died)


# --- The document ----------------------------------------------------------------------------------------------------
# What the campaign's outcomes say as one document: a row for each scenario, and the worst times of each kind of loss.
# Terminal, JSON and page read it.


HEADER = ("Scenario", "Passed", "Ends", "Loss", "Left / ms", "Gone / ms", "Lost", "Recovered", "Injected", "Detected")
_LOSS_TEXT = {Loss.FEEDBACK: "feedback", Loss.MASTER: "master"}


def document(outcomes: Sequence[Outcome], planned: int) -> dict[str, Any]:
    """Everything as plain data; `planned` scenarios were to run."""
    return {
        "planned": planned,
        "run": len(outcomes),
        "files": _files(outcomes),
        "passed": sum(outcome.passed for outcome in outcomes),
        "lost_records": sum(lost_records(outcomes)),
        "recorded": len(lost_records(outcomes)),
        "worst": worst(outcomes),
        "scenarios": [_plain(outcome) for outcome in outcomes],
    }


def worst(outcomes: Sequence[Outcome]) -> dict[str, dict[str, float | None]]:
    """Longest times by kind of loss, in ms of bus time; None where no scenario of the kind ran. Those that are exempt
    from the bound are counted and do not enter the times."""
    table: dict[str, dict[str, float | None]] = {}
    for loss, text in _LOSS_TEXT.items():
        of_kind = [outcome for outcome in outcomes if outcome.loss is loss]
        times = [outcome.reaction for outcome in of_kind if outcome.exempt is None]
        table[text] = {
            "scenarios": len(times),
            "exempt": len(of_kind) - len(times),
            "left_ms": max((t.left_ms for t in times if t.left_ms is not None), default=None),
            "gone_ms": max((t.gone_ms for t in times if t.gone_ms is not None), default=None),
        }
    return table


def cells(outcome: Outcome) -> tuple[str, ...]:
    """One row of the table, under HEADER."""
    return (
        outcome.name,
        "yes" if outcome.passed else "NO",
        outcome.axis,
        ("" if outcome.exempt is None else "exempt: ") + _LOSS_TEXT.get(outcome.loss, "-"),
        milliseconds(outcome.reaction.left_ms),
        milliseconds(outcome.reaction.gone_ms),
        "-" if outcome.lost_records is None else str(outcome.lost_records),
        "yes" if outcome.recovered else "by repair" if outcome.by_repair else "no",
        outcome.injected,
        ", ".join(outcome.detected) or ("refused" if outcome.axis == "DISABLED" and outcome.remedy else "-"),
    )


def text_table(outcomes: Sequence[Outcome]) -> str:
    """The table for a terminal, as wide as it is: nothing of it is cut."""
    rows = [HEADER, *map(cells, outcomes)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join("  ".join(map(str.ljust, row, widths)).rstrip() for row in rows)


def summary(outcomes: Sequence[Outcome], planned: int) -> list[str]:
    """The campaign in a few sentences."""
    passed = sum(outcome.passed for outcome in outcomes)
    lines = [f"{passed} of {counted(len(outcomes), 'scenario')} in {counted(_files(outcomes), 'file')} passed."]
    if len(outcomes) < planned:
        lines.append(f"{planned - len(outcomes)} of {planned} were not run.")
    for loss, row in worst(outcomes).items():
        if row["scenarios"]:
            lines.append(
                f"Loss of {loss}: {counted(int(row['scenarios']), 'scenario')}, the drive had left the controller's "
                f"command after {milliseconds(row['left_ms'])} ms and the torque was gone after "
                f"{milliseconds(row['gone_ms'])} ms at the latest."
            )
    lines += [f"Exempt from the bound: {o.name}: {o.exempt}." for o in outcomes if o.exempt is not None]
    recovered, repairs = sum(o.recovered for o in outcomes), sum(o.by_repair for o in outcomes)
    lines.append(f"Recovered: {recovered}; {repairs} need repair at the hardware.")
    lost = lost_records(outcomes)
    lines.append(f"Cycle records lost: {sum(lost)} in {counted(len(lost), 'scenario')} with a recorder.")
    return lines


def lost_records(outcomes: Sequence[Outcome]) -> list[int]:
    """Of each scenario in which a recorder ran."""
    return [outcome.lost_records for outcome in outcomes if outcome.lost_records is not None]


def _files(outcomes: Sequence[Outcome]) -> int:
    """A file may hold several scenarios; theirs are named `file/name`."""
    return len({outcome.name.partition("/")[0] for outcome in outcomes})


def milliseconds(value: float | None) -> str:
    """A time for people; what did not happen is a dash."""
    return "-" if value is None else f"{value:.1f}"


def _plain(outcome: Outcome) -> dict[str, Any]:
    return {
        "name": outcome.name,
        "title": outcome.title,
        "group": outcome.group,
        "loss": outcome.loss.value,
        "exempt": outcome.exempt,
        "injected": outcome.injected,
        "detected": list(outcome.detected),
        "remedy": outcome.remedy,
        "axis": outcome.axis,
        "left_ms": outcome.reaction.left_ms,
        "gone_ms": outcome.reaction.gone_ms,
        "fastest_rad_s": None if outcome.stop is None else outcome.stop.fastest_rad_s,
        "travel_rad": None if outcome.stop is None else outcome.stop.to_rest_rad,
        "stated": outcome.stated,
        "lost_records": outcome.lost_records,
        "recovered": outcome.recovered,
        "passed": outcome.passed,
        "complaints": list(outcome.complaints),
    }


# --- The page --------------------------------------------------------------------------------------------------------
# The page of `servoctl qualify faults`: what was injected, what the drive did, and what the user was told. Needs the
# lab part. All text is escaped by the page.


_TIMES = (
    "Times count from the first injection, in bus time, and come from the virtual drive's own record. Left: the drive "
    "left operation enabled, and with it the controller's command; gone: the joint feels no torque from then on. "
    "Lost: cycles without a record, where a recorder ran. Recovered: the axis was enabled again by what the fault's "
    "remedy says."
)


def write_page(outcomes: Sequence[Outcome], planned: int, path: Path) -> None:
    """Write the page to `path`. Raises BadInput when that is not possible."""
    from servod.lab.report.figure import PageTable
    from servod.lab.report.page import Page, Verdict

    first, *rest = summary(outcomes, planned)
    passed = all(outcome.passed for outcome in outcomes) and len(outcomes) == planned
    page = Page("servod: the fault campaign", Verdict(first, passed))
    page.points(rest)
    page.sentence(_TIMES)
    _failures(page, outcomes)
    by_group = sorted(outcomes, key=lambda outcome: (outcome.group, outcome.name))
    for group, members in groupby(by_group, key=lambda outcome: outcome.group):
        rows = sorted(members, key=_worst_first)
        title = f"{group.capitalize()}: {counted(len(rows), 'scenario')}"
        page.heading(title)
        failed = not all(outcome.passed for outcome in rows)
        page.table(PageTable(title, HEADER, tuple(map(cells, rows))), folded=not failed)
        page.folded("What each is, and what the user was told", [_remedy_line(outcome) for outcome in rows])
    page.write(path)


def _worst_first(outcome: Outcome) -> tuple[bool, float]:
    """Failed before passed, then by how long the torque stayed."""
    return outcome.passed, -(outcome.reaction.gone_ms or 0.0)


def _failures(page: Page, outcomes: Sequence[Outcome]) -> None:
    failed = [outcome for outcome in outcomes if not outcome.passed]
    if failed:
        page.heading("Not as expected")
        page.points([f"{outcome.name}: {'; '.join(outcome.complaints)}" for outcome in failed])


def _remedy_line(outcome: Outcome) -> str:
    return f"{outcome.name}: {outcome.title}. {outcome.remedy or 'Nothing was to be told.'}"
