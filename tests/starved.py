"""Tells a test that failed because other programs held the processors from one that failed.

A failure of a test of real processes (mark `serial` or `processes`) becomes a skip with figures when both hold:

- While it ran, or while a fixture of it was made, programs that the tests did not start took the processors, and the
  kernel counted that programs waited for them; or a whole processor stood still, as those of virtual machines do: a
  program that goes before all others there did not run either. What the tests and their children use themselves never
  counts, so code that burns time excuses nothing. Or the loop may not go before others (SCHED_FIFO is refused to this
  user): then whatever runs anywhere, the tests' own attackers too, takes its turn. That excuses no time-out.
- Time is what failed: a time-out, a fault of lateness and none beside it in the message or in the daemon's log, or a
  comparison in a test that compares times alone (mark `wall_clock`). What a drive did, a torque, a limit or another
  fault fails on any machine.

A test that failed on a starved machine is run again, up to twice, before it is judged.
"""

from __future__ import annotations

import os
import re
import select
import subprocess
import sys
import time
from collections.abc import Collection, Generator, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from _pytest.outcomes import OutcomeException
from _pytest.runner import runtestprotocol  # as pytest-rerunfailures has it: there is no public one

from servod.common.errors import ServodError
from servod.common.faults import FaultCode
from servod.formats.config import CycleConfig

#: Share of all processors that others took, and of the time in which somebody waited; and the first where no kernel
#: counts the second (Linux without PSI).
OTHERS_SHARE, WAITED_SHARE, OTHERS_ALONE_SHARE = 0.25, 0.1, 0.5
#: A shorter span tells no share [s]: the kernel counts processor time by ticks of 10 ms.
LEAST_SPAN_S = 0.2
#: The shortest stand-still of a processor that makes feedback stale: the default of limits.stale_cycles.
STALL_S = 0.005
#: An axis that one test leaves to the next shows this long afterwards what a stand-still did to it.
SHOWS_AFTER_S = 1.0
#: What a loop, a drive or a supervisor that does not get its turn comes to, by itself. A following error is not among
#: them: an axis that runs away has it too.
LATENESS = {
    *(FaultCode.DEADLINE_LATE, FaultCode.DEADLINE_BUDGET, FaultCode.FEEDBACK_STALE, FaultCode.SUPERVISOR_LOST),
    *(FaultCode.NODE_HEARTBEAT_LOST, FaultCode.COMMANDS_LOST, FaultCode.BUS_QUEUE_FULL),
    # A drive that is not heard to stop is told by NMT, and must be configured again.
    *(FaultCode.DRIVE_STAYS_POWERED, FaultCode.NODE_LEFT_OPERATIONAL),
}
#: Logs of the daemons that the tests of this file started.
LOGS: list[Path] = []
_LOGGED = re.compile(r"fault (\w+) \(")
#: A drive that missed its master says so by EMCY 0x8130 (CiA 301, life guard or heartbeat error).
_EMCY, _MISSED_ITS_MASTER = re.compile(r"EMCY 0x([0-9A-F]{4}) .*\(DRIVE_FAULT\)"), {"8130"}
#: From where a daemon is ended to where the next begins.
_ENDED = re.compile(r" INFO stopping: .*?(?= INFO gain set |\Z)", re.DOTALL)
_FOLLOWS = re.compile(r"a fault is latched|'FAULT'|is FAULT|the axis is not enabled|must be configured again")
#: Sleeps on one processor before all that servod starts there, and tells when it slept too long, and how much [s].
_WITNESS = """
import os, sys, time
os.sched_setaffinity(0, {int(sys.argv[1])})
os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(98))
last = time.monotonic()
while True:
    time.sleep(0.002)
    now = time.monotonic()
    if now - last > 0.002 + float(sys.argv[2]):
        print(now, now - last - 0.002, flush=True)
    last = now
"""
#: A motion of a minute meets two stand-stills that it cannot ride out on a machine that has one in some minutes.
AGAIN = 2
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
    stall_s: float = 0.0

    @property
    def starved(self) -> str:
        """The evidence in a few words; empty when there is none."""
        if self.stall_s >= STALL_S:
            return f"a processor stood still for {1e3 * self.stall_s:.0f} ms"
        if self.seconds < LEAST_SPAN_S:
            return ""
        others = self.others_s / (self.seconds * self.cores)
        said = f"other programs had {others:.0%} of {self.cores} processors for {self.seconds:.1f} s"
        if self.waited_s is None:
            return said if others > OTHERS_ALONE_SHARE else ""
        waited = self.waited_s / self.seconds
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


def refused(priority: int = CycleConfig().priority) -> str:
    """What keeps a loop of this user from going before other programs; empty where nothing does."""
    policy, param = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except PermissionError:
        return f"this user may not use SCHED_FIFO {priority}, so any program goes before the loop"
    os.sched_setscheduler(0, policy, param)
    return ""


def logged(logs: Iterable[Path]) -> set[str]:
    """The faults that daemons wrote down."""
    return {name for log in logs if log.exists() for name in written(log.read_text(errors="replace"))}


def written(text: str) -> set[str]:
    """The faults in the log of daemons, or in what a test says of it, each until it was ended.

    A drive's own that it had for want of heartbeats is one of heartbeats. What comes when a test that failed ends its
    processes, bus and encoder first, is no cause of it.
    """
    text = _ENDED.sub("", text)
    faults, told = _LOGGED.findall(text), _EMCY.findall(text)
    if 0 < faults.count("DRIVE_FAULT") <= len(told) and set(told) == _MISSED_ITS_MASTER:
        return set(faults) - {"DRIVE_FAULT"} | {"NODE_HEARTBEAT_LOST"}
    return set(faults)


class Stalls:
    """When processors stood still. Without rights to go before other programs (SCHED_FIFO) it saw nothing."""

    def __init__(self) -> None:
        self._witnesses: list[subprocess.Popen[bytes]] = []
        self._seen: list[tuple[float, float]] = []

    def watch(self) -> None:
        """Begin, if it has not; a witness ends with the pipe that nobody reads any more."""
        for core in () if self._witnesses else sorted(os.sched_getaffinity(0)):
            command = [sys.executable, "-I", "-S", "-c", _WITNESS, str(core), str(STALL_S)]
            self._witnesses.append(subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL))

    def longest_s(self, first_s: float, last_s: float) -> float:
        """The longest that ended between two times, or shortly before."""
        pipes = [witness.stdout for witness in self._witnesses]
        while ready := select.select(pipes, [], [], 0)[0]:
            lines = b"".join(os.read(pipe.fileno(), 1 << 16) for pipe in ready).splitlines()  # each written whole
            self._seen += [(float(end), float(length)) for end, length in map(bytes.split, lines)]
            if not lines:  # they could not begin
                break
        return max((length for end, length in self._seen if first_s - SHOWS_AFTER_S <= end <= last_s), default=0.0)

    def end(self) -> None:
        """Leave no process behind."""
        for witness in self._witnesses:
            witness.kill()
            witness.wait()
        self._witnesses.clear()


def by_lateness(error: BaseException, times_alone: bool, faults: Collection[str] = ()) -> bool:
    """Whether time is what failed; `times_alone`: the test compares nothing but times, `faults`: those of its axis."""
    if faults and {FaultCode[name] for name in faults} <= LATENESS:
        follows = _FOLLOWS.search(str(error)) or any(name in str(error) for name in faults)
        if follows and isinstance(error, ServodError | AssertionError):
            return True
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
        self._stalls, self._refused = Stalls(), refused()

    def pytest_unconfigure(self) -> None:
        """The last hook."""
        self._stalls.end()

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Generator[None, Any, Any]:
        """Read before its fixtures are made."""
        if item.path != self._file:
            LOGS.clear()
        self._file, self._began = item.path, None
        if _judged(item):
            self._stalls.watch()
            self._began = read()
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
            self._fixtures[f"{fixturedef.baseid}::{fixturedef.argname}"] = self._since(first)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(
        self, item: pytest.Item, call: pytest.CallInfo[None]
    ) -> Generator[None, pytest.TestReport, pytest.TestReport]:
        """Make of a failure a skip that says why, if that is what it is."""
        report = yield
        if report.failed and call.excinfo is not None and self._began is not None:
            spans = [self._since(self._began), *self._of_fixtures(item)]
            starved, error = next((span.starved for span in spans if span.starved), ""), call.excinfo.value
            never_came = isinstance(error, TimeoutError | subprocess.TimeoutExpired)
            evidence = starved if never_came else starved or self._refused
            times_alone = item.get_closest_marker("wall_clock") is not None
            if evidence and by_lateness(error, times_alone, logged(LOGS) | written(str(error))):
                report.outcome = "skipped"
                said = f"Skipped: the machine was starved: {evidence} ({call.excinfo.exconly()[:200]})"
                report.longrepr = (str(item.path), (item.location[1] or 0) + 1, said)
        return report

    def evidence(self, first: Reading) -> str:
        """What says that the machine was starved since `first`, within a test; empty where nothing does."""
        return "" if self._began is None else self._since(first).starved or self._refused

    def _since(self, first: Reading) -> Span:
        last = read()
        return between(first, last)._replace(stall_s=self._stalls.longest_s(first.now_s, last.now_s))

    def _of_fixtures(self, item: pytest.Item) -> Iterable[Span]:
        names: list[str] = getattr(item, "fixturenames", [])
        return (span for key, span in self._fixtures.items() for name in names if _belongs(item, key, name))


class Again:
    """Runs a test of the wall clock that failed on a starved machine again, up to AGAIN times; the last run counts.

    An axis that stood still for longer than a motion allows can have any fault, so none is excused: a later run that
    passes shows that it was the machine, and each failure wants its own evidence. On an idle machine nothing is run
    twice.
    """

    def __init__(self, judge: Judge) -> None:
        self._judge = judge

    @staticmethod
    def _end_fixtures_of_file(item: pytest.Item) -> None:
        """So that they are made again: pytest keeps what one raised, or measured on the starved machine."""
        file = item.getparent(pytest.Module)
        try:
            item.session._setupstate.teardown_exact(file.parent if file is not None else None)  # type: ignore[arg-type]
        except (Exception, OutcomeException) as error:
            item.warn(pytest.PytestWarning(f"a fixture did not end: {error}"))

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_protocol(self, item: pytest.Item, nextitem: pytest.Item | None) -> bool | None:
        """All of a test's reports, told when they are the last."""
        if not _judged(item):
            return None
        item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
        for left in reversed(range(AGAIN + 1)):
            first = read()
            reports = runtestprotocol(item, nextitem=nextitem, log=False)
            failed = left and any(report.failed for report in reports)
            if not failed or not (evidence := self._judge.evidence(first)):
                break
            item.warn(pytest.PytestWarning(f"ran again, the machine was starved: {evidence}"))
            self._end_fixtures_of_file(item)
        for report in reports:
            item.ihook.pytest_runtest_logreport(report=report)
        item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
        return True


def _judged(item: pytest.Item) -> bool:
    return any(item.get_closest_marker(name) for name in ("serial", "processes", "wall_clock"))


def _belongs(item: pytest.Item, key: str, name: str) -> bool:
    base, _, fixture = key.rpartition("::")
    return fixture == name and item.nodeid.startswith(base)
