"""Tells a test that failed because other programs held the processors from one that failed.

A failure of a test of real processes (mark `serial` or `processes`) becomes a skip with figures when both hold:

- While it ran, or while a fixture of it was made, programs that the tests did not start took the processors, and the
  kernel counted that programs waited for them. What the tests and their children use themselves never counts, so code
  that burns time excuses nothing.
- Time is what failed: a time-out, a fault of lateness and none beside it in the message or in the daemon's log, or a
  comparison in a test that compares times alone (mark `wall_clock`). What a drive did, a torque, a limit or another
  fault fails on any machine.
"""

from __future__ import annotations

import os
import re
import subprocess
import time
from collections.abc import Collection, Generator, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from servod.common.errors import ServodError
from servod.common.faults import FaultCode

#: Share of all processors that others took, and of the time in which somebody waited; and the first where no kernel
#: counts the second (Linux without PSI).
OTHERS_SHARE, WAITED_SHARE, OTHERS_ALONE_SHARE = 0.25, 0.1, 0.5
#: What a loop, a drive or a supervisor that does not get its turn comes to, by itself. A following error is not among
#: them: an axis that runs away has it too.
LATENESS = {
    *(FaultCode.DEADLINE_LATE, FaultCode.DEADLINE_BUDGET, FaultCode.FEEDBACK_STALE, FaultCode.SUPERVISOR_LOST),
    *(FaultCode.NODE_HEARTBEAT_LOST, FaultCode.COMMANDS_LOST, FaultCode.BUS_QUEUE_FULL),
}
#: Logs of the daemons that the tests of this file started.
LOGS: list[Path] = []
_LOGGED, _FOLLOWS = re.compile(r"fault (\w+) \("), re.compile(r"a fault is latched|'FAULT'")
_OURS = "SERVOD_TEST_RUN"
_TICKS = os.sysconf("SC_CLK_TCK")
_WAITED = re.compile(r"some .*total=(\d+)")


class Reading(NamedTuple):
    """The kernel's counters at one time [s]; `waited_s`: somebody waited for a processor, None where not counted."""

    now_s: float
    busy_s: float
    own_s: float
    waited_s: float | None


class Span(NamedTuple):
    """What was counted between two readings."""

    seconds: float
    cores: int
    others_s: float
    waited_s: float | None

    @property
    def starved(self) -> str:
        """The evidence in a few words; empty when there is none."""
        others = self.others_s / (self.seconds * self.cores) if self.seconds > 0.0 else 0.0
        said = f"other programs had {others:.0%} of {self.cores} processors for {self.seconds:.1f} s"
        if self.waited_s is None:
            return said if others > OTHERS_ALONE_SHARE else ""
        waited = self.waited_s / self.seconds if self.seconds > 0.0 else 0.0
        both = others > OTHERS_SHARE and waited > WAITED_SHARE
        return f"{said}, and some waited {waited:.0%} of it" if both else ""


def read() -> Reading:
    """All counters now."""
    fields = [int(field) for field in Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:9]]
    user, nice, system, _idle, _waits, interrupts, soft, stolen = fields
    busy_s = (user + nice + system + interrupts + soft + stolen) / _TICKS
    return Reading(time.monotonic(), busy_s, sum(os.times()[:4]) + _children_s(), _waited_s())


def between(first: Reading, last: Reading) -> Span:
    """What happened meanwhile; what the tests used is taken off."""
    others_s = max(0.0, last.busy_s - first.busy_s - max(0.0, last.own_s - first.own_s))
    waited_s = None if first.waited_s is None or last.waited_s is None else last.waited_s - first.waited_s
    return Span(last.now_s - first.now_s, os.cpu_count() or 1, others_s, waited_s)


def _children_s() -> float:
    """Processor time of all living processes that the tests started, whoever is their parent by now."""
    mark, total = f"{_OURS}={os.environ.get(_OURS)}".encode(), 0
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if int(process.name) != os.getpid() and mark in (process / "environ").read_bytes().split(b"\0"):
                fields = (process / "stat").read_text().rpartition(")")[2].split()
                total += sum(int(field) for field in fields[11:15])
        except OSError:  # it has gone, or is somebody else's
            continue
    return total / _TICKS


def _waited_s() -> float | None:
    try:
        found = _WAITED.search(Path("/proc/pressure/cpu").read_text())
    except OSError:
        return None
    return int(found[1]) / 1e6 if found else None


def logged(logs: Iterable[Path]) -> set[str]:
    """The faults that daemons wrote down."""
    return {name for log in logs if log.exists() for name in _LOGGED.findall(log.read_text(errors="replace"))}


def by_lateness(error: BaseException, times_alone: bool, faults: Collection[str] = ()) -> bool:
    """Whether time is what failed; `times_alone`: the test compares nothing but times, `faults`: those of its axis."""
    if faults and {FaultCode[name] for name in faults} <= LATENESS and _FOLLOWS.search(str(error)):
        return isinstance(error, ServodError | AssertionError)
    if isinstance(error, TimeoutError | subprocess.TimeoutExpired):
        return True
    if isinstance(error, AssertionError):
        return times_alone
    named = {code for code in FaultCode if re.search(rf"\b{code.name}\b", str(error))}
    return isinstance(error, ServodError) and bool(named) and named <= LATENESS


class Judge:
    """The hooks of pytest: reads at the begin of each test and fixture, judges what fails."""

    def __init__(self) -> None:
        os.environ.setdefault(_OURS, str(os.getpid()))
        self._began: Reading | None = None
        self._file: Path | None = None
        self._fixtures: dict[str, Span] = {}

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Generator[None, Any, Any]:
        """Read before its fixtures are made."""
        if item.path != self._file:
            LOGS.clear()
        self._file, self._began = item.path, read() if _judged(item) else None
        return (yield)

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: pytest.FixtureDef[Any]) -> Generator[None, Any, Any]:
        """What a fixture of a whole file measured is judged by its own time; it may fail a test an hour later."""
        if self._began is None or fixturedef.scope == "function":
            return (yield)
        first = read()
        try:
            return (yield)
        finally:
            self._fixtures[f"{fixturedef.baseid}::{fixturedef.argname}"] = between(first, read())

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(
        self, item: pytest.Item, call: pytest.CallInfo[None]
    ) -> Generator[None, pytest.TestReport, pytest.TestReport]:
        """Make of a failure a skip that says why, if that is what it is."""
        report = yield
        if report.failed and call.excinfo is not None and self._began is not None:
            spans = [between(self._began, read()), *self._of_fixtures(item)]
            evidence = next((span.starved for span in spans if span.starved), "")
            times_alone = item.get_closest_marker("wall_clock") is not None
            if evidence and by_lateness(call.excinfo.value, times_alone, logged(LOGS)):
                report.outcome = "skipped"
                said = f"Skipped: the machine was starved: {evidence} ({call.excinfo.exconly()[:200]})"
                report.longrepr = (str(item.path), (item.location[1] or 0) + 1, said)
        return report

    def _of_fixtures(self, item: pytest.Item) -> Iterable[Span]:
        names: list[str] = getattr(item, "fixturenames", [])
        return (span for key, span in self._fixtures.items() for name in names if _belongs(item, key, name))


def _judged(item: pytest.Item) -> bool:
    return any(item.get_closest_marker(name) for name in ("serial", "processes", "wall_clock"))


def _belongs(item: pytest.Item, key: str, name: str) -> bool:
    base, _, fixture = key.rpartition("::")
    return fixture == name and item.nodeid.startswith(base)
