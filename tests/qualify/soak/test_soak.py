"""A short soak with a dense schedule, and episodes that lie: what the schedule does not explain is found out."""

from __future__ import annotations

import itertools
import json
import os
import signal
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from servod.cli.app import run as servoctl
from servod.common.errors import Unreachable
from servod.common.faults import FaultCode
from servod.qualify.faults.scenario import Recovery
from servod.qualify.soak.document import Course, added, document, verdict
from servod.qualify.soak.kinds import KINDS, InjectionKind
from servod.qualify.soak.launch import DOCUMENT_NAME, Order, SoakWatch, launch, run
from servod.qualify.soak.memory import Memory
from servod.qualify.soak.plan import Episode, Move, SoakEnding, schedule
from servod.qualify.soak.stepped import GAIN_SETS, SteppedSoak
from servod.qualify.soak.tally import Wrong
from servod.runtime.loop.commands import ReferenceKind

_KIND = {kind.name: kind for kind in KINDS}
_RIDDEN = [kind for kind in KINDS if not kind.expects]
_SINE = Move(ReferenceKind.SINE, (0.1, 1.0, 1.0), 1.0)


def quiet(_line: str, _share: float) -> None:
    """Progress that nobody sees."""


def befallen(fault: InjectionKind) -> Episode:
    """An episode in which `fault` comes."""
    return Episode(1, None, _SINE, 0.25, fault, SoakEnding.FINISH, 1)


def children() -> set[int]:
    """Processes that this one started."""
    return {int(pid) for task in Path("/proc/self/task").iterdir() for pid in (task / "children").read_text().split()}


@pytest.fixture(scope="module")
def axis(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SteppedSoak]:
    soak = SteppedSoak(1, tmp_path_factory.mktemp("soak"))
    yield soak
    soak.close()


@pytest.fixture
def wrong(axis: SteppedSoak) -> Counter[Wrong]:
    """What was found wrong in this test, told from what was found before."""
    axis.findings.counts.clear()
    return axis.findings.counts


def test_twenty_thousand_cycles_of_faults_leave_nothing_wrong(tmp_path: Path) -> None:
    soak = SteppedSoak(7, tmp_path)
    found = run(soak, schedule(7, GAIN_SETS), 20_000, 600.0, tmp_path, quiet)
    soak.close()
    assert found["passed"], found["findings"]
    rows = found["cycles"] - found["missed"]  # those in which the loop stands still while the supervisor brakes
    assert rows == found["rows"] == found["syncs"] + found["syncs_taken"] >= 20_000
    assert found["faults_due"] == found["faults_found"] >= 3 and found["faults_ridden_through"] >= 2
    seen = found["faults_found"] + found["faults_ridden_through"] + found["faults_spoilt_proof"]
    assert found["faults_injected"] == found["faults_recovered"] == seen
    assert found["recordings"] == 2 and found["rows_read_back"] > 100
    assert json.loads((tmp_path / DOCUMENT_NAME).read_text()) == found


def test_the_same_seed_gives_the_same_schedule_and_every_kind_comes() -> None:
    first, again, other = (list(itertools.islice(schedule(seed, GAIN_SETS), 120)) for seed in (1, 1, 2))
    assert first == again != other
    assert {e.fault.name for e in first if e.fault} == set(_KIND)


def test_ctrl_c_leaves_a_report_of_what_was_done(axis: SteppedSoak, wrong: Counter[Wrong], tmp_path: Path) -> None:
    def interrupted() -> Iterator[Episode]:
        yield befallen(_KIND["frames destroyed"])
        raise KeyboardInterrupt

    found = run(axis, interrupted(), 10**9, 600.0, tmp_path, quiet)
    assert found["interrupted"] and not found["passed"] and not wrong
    assert found["unproven"] == ["interrupted"] and "No pass: interrupted." in verdict(found)
    assert json.loads((tmp_path / DOCUMENT_NAME).read_text())["rows"] == found["rows"] > 0


@pytest.mark.parametrize(
    ("lie", "finding"),
    [
        (replace(_KIND["error in the drive"], expects=frozenset({FaultCode.BUS_OFF})), Wrong.NOT_FOUND),
        (replace(_KIND["error in the drive"], expects=frozenset()), Wrong.UNEXPLAINED),
        (replace(_KIND["error in the drive"], expects=frozenset()), Wrong.NO_TRACE),
        (replace(_KIND["frames destroyed"], do=_KIND["safe torque off"].undo or {}), Wrong.NO_TRACE),
        (replace(_KIND["encoder feedback lost, many"], gone_ms=1.0), Wrong.LATE),
        (replace(_KIND["encoder feedback lost, many"], latched_ms=1.0), Wrong.LATE),
        (replace(_KIND["encoder feedback lost, many"], left_ms=1.0), Wrong.LATE),
        (replace(_KIND["SYNC lost, a few"], takes_syncs=False), Wrong.SYNC),
        (replace(_KIND["error in the drive"], recovery=Recovery.ENABLE), Wrong.NOT_RECOVERED),
    ],
)
def test_what_the_schedule_does_not_explain_is_found(
    axis: SteppedSoak, wrong: Counter[Wrong], lie: InjectionKind, finding: Wrong
) -> None:
    axis.episode(befallen(lie))
    assert finding in wrong


@pytest.mark.parametrize("kind", _RIDDEN, ids=lambda kind: kind.name)
def test_what_is_ridden_through_counts_only_if_it_happened(
    axis: SteppedSoak, wrong: Counter[Wrong], monkeypatch: pytest.MonkeyPatch, kind: InjectionKind
) -> None:
    """By the bus itself: the same episode with nothing injected is found out."""
    before = replace(axis.tally.of(kind.name))
    axis.episode(replace(befallen(kind), number=2))
    told = axis.tally.of(kind.name)
    assert (told.ridden, told.found, told.due) == (before.ridden + 1, 0, 0) and not wrong
    monkeypatch.setattr(axis, "_act", lambda _injection: None)
    axis.episode(replace(befallen(kind), number=2))
    assert wrong == {Wrong.NO_TRACE: 1} and axis.tally.of(kind.name).ridden == before.ridden + 1


def test_every_loss_of_feedback_is_held_to_fifty_milliseconds() -> None:
    losses = [kind for kind in KINDS if FaultCode.FEEDBACK_STALE in kind.expects and "encoder" in kind.name]
    assert len(losses) == 6 and {kind.left_ms for kind in losses} == {kind.latched_ms for kind in losses} == {50.0}


@pytest.mark.parametrize("name", ["encoder alarm", "drive feedback lost, many", "encoder feedback lost, a few"])
def test_a_fault_while_the_wiring_is_proven_leaves_nothing_wrong(
    axis: SteppedSoak, wrong: Counter[Wrong], name: str
) -> None:
    before = axis.tally.of(name).proving
    axis.episode(replace(befallen(_KIND[name]), before_s=0.2, proves=True))
    assert axis.tally.of(name).proving == before + 1 and not wrong


def test_the_wiring_is_proven_after_every_start(axis: SteppedSoak, wrong: Counter[Wrong]) -> None:
    axis.episode(befallen(_KIND["encoder reset"]))
    proof = axis._axis.session.proof
    assert proof is not None and proof.passed and not wrong


def test_a_recorder_that_loses_a_row_is_found(
    axis: SteppedSoak, wrong: Counter[Wrong], monkeypatch: pytest.MonkeyPatch
) -> None:
    recorder = axis._recorder._recorder
    takes = recorder.add_rows
    monkeypatch.setattr(recorder, "add_rows", lambda rows: takes(rows[1:]))
    axis.episode(replace(befallen(_KIND["frames destroyed"]), number=1))
    assert wrong == {Wrong.RECORDER: 1}


def test_a_run_that_ends_by_itself_short_of_its_order_is_no_pass(axis: SteppedSoak, tmp_path: Path) -> None:
    def lost() -> Iterator[Episode]:
        raise Unreachable("the axis is not there any more")
        yield

    found = run(axis, lost(), 10**9, 600.0, tmp_path, quiet)
    axis.findings.counts.clear()
    assert not found["passed"] and found["unproven"] == [Course.CUT_SHORT]


def test_jobs_that_are_killed_are_no_pass(tmp_path: Path) -> None:
    killed, before = set[int](), children()

    def kill(_line: str, _share: float) -> None:
        """Both have told of their first episodes."""
        for job in children() - before:
            os.kill(job, signal.SIGKILL)
            killed.add(job)

    found = launch(Order(10**9, 1, False, None, tmp_path), 2, kill)
    assert len(killed) == 2 and found["cycles"] > 0
    assert not found["passed"] and found["wrong"] == {}
    assert found["unproven"][-2:] == ["job 1 ended with -9", "job 2 ended with -9"]


def test_a_short_run_says_that_it_cannot_tell_of_memory(axis: SteppedSoak, tmp_path: Path) -> None:
    axis.findings.counts.clear()
    found = run(axis, [befallen(_KIND["encoder alarm"])], 10**9, 600.0, tmp_path, quiet)
    assert found["passed"] and found["untold"] == ["soak"] and "not told by so short a watch: soak" in verdict(found)


def test_memory_is_watched_in_the_time_that_the_axis_has_run(axis: SteppedSoak) -> None:
    """Stepped, a day of it takes two hours, and what leaks leaks by cycles."""
    watch = SoakWatch(limit_s=1.0)
    for axis_s in (0.0, 1.0, 3600.0, 14400.0):
        watch.look(axis.processes(), axis_s)
    (memory,) = watch.longest.values()
    assert memory.watched_s == 14400.0 and memory.curve[:, 0].tolist() == [0.0, 3600.0, 14400.0]


def test_a_long_watch_that_cannot_tell_of_memory_is_no_pass(axis: SteppedSoak) -> None:
    for hours, unproven in ((1.0, []), (4.0, ["memory of daemon cannot be told after 4.0 h of axis time"])):
        memory, chance = Memory(), np.random.default_rng(1)
        for hour in np.linspace(0.0, hours, 100):  # what it breathes hides what it may grow by
            memory.add(hour * 3600.0, 1e5 + chance.uniform(0.0, 30_000.0), 8)
        axis.findings.counts.clear()
        found = document(axis, {"daemon": memory}, hours * 3600.0, Course.COMPLETE)
        assert found["unproven"] == unproven and found["passed"] is (not unproven) and found["untold"] == ["daemon"]


def test_several_runs_add_up(axis: SteppedSoak, tmp_path: Path) -> None:
    found = run(axis, [befallen(_KIND["encoder alarm"])], 1, 600.0, tmp_path, quiet)
    both = added([found, found])
    assert both["cycles"] == 2 * found["cycles"]
    alarm, alarms = found["faults"]["encoder alarm"], both["faults"]["encoder alarm"]
    assert alarms["injected"] == 2 * alarm["injected"]
    assert alarms["detected"]["median_ms"] == alarm["detected"]["median_ms"]
    assert alarms["detected"]["count"] == 2 * alarm["detected"]["count"] > 0


def test_the_command_writes_its_document_and_its_page(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert servoctl(["qualify", "soak", "--cycles", "1500", "--seed", "2", "--out", str(tmp_path), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["mode"] == "stepped" and found["seeds"] == [2] and found["cycles"] >= 1500
    assert "Nothing wrong" in (tmp_path / "soak.html").read_text()
