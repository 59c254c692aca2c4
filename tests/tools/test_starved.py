"""The judge of tests that fail on a busy machine: what it excuses, and above all what it does not."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest
import source

from servod.client.control import Refused
from servod.common.errors import BadInput, Unreachable
from servod.formats.config import CycleConfig
from tests import starved
from tests.starved import Reading, Span, Stalls, between, by_lateness, logged, read, written

TESTS = """
import pytest
from servod.common.errors import Unreachable

pytestmark = pytest.mark.serial

@pytest.fixture(scope="module")
def measured():
    return 7

def test_torque_is_limited():
    assert 1.3 <= 0.9

def test_it_came_in_time():
    raise TimeoutError("it did not come")

@pytest.mark.wall_clock
def test_it_was_fast(measured):
    assert measured < 5

def test_the_loop_had_its_turn():
    raise Unreachable("the axis stopped: FEEDBACK_STALE: no feedback")

def test_the_axis_did_not_run_away():
    raise Unreachable("the axis stopped: SPEED_LIMIT: too fast; FEEDBACK_STALE: no feedback")

def test_it_passes():
    pass
"""
CONFTEST = """
import itertools
from tests import starved

def pytest_configure(config):
    count = itertools.count()
    starved.read = lambda: starved.Reading(n := next(count), n * {busy}, 0.0, n * {waited})
    starved.refused = lambda: {refused!r}
    judge = starved.Judge()
    config.pluginmanager.register(judge, "starved")
    config.pluginmanager.register(starved.Again(judge), "again")
"""


def outcomes(
    folder: Path, busy: float, waited: float, text: str = TESTS, refused: str = ""
) -> tuple[dict[str, str], str]:
    """Outcome of every test in a run of its own, on a machine with these counts in each second; and what was said."""
    (folder / "test_axis.py").write_text(text)
    made = CONFTEST.format(busy=busy * (os.cpu_count() or 1), waited=waited, refused=refused)
    (folder / "conftest.py").write_text(made)
    (folder / "pytest.ini").write_text("[pytest]\nmarkers =\n  serial\n  wall_clock\n")
    command = [sys.executable, "-m", "pytest", "-v", "-rs", "-p", "no:cacheprovider", "-p", "no:xdist", str(folder)]
    environment = os.environ | {"PYTHONPATH": str(source.ROOT), "COLUMNS": "300"}
    said = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=60).stdout
    return dict(re.findall(r"::(test_\w+) (PASSED|FAILED|SKIPPED|ERROR)", said)), said


FAILED_ALWAYS = {"test_torque_is_limited": "FAILED", "test_the_axis_did_not_run_away": "FAILED"}
OF_TIME = ("test_it_came_in_time", "test_it_was_fast", "test_the_loop_had_its_turn")


def test_on_a_starved_machine_lateness_is_told_and_all_else_fails(tmp_path: Path) -> None:
    found, said = outcomes(tmp_path, busy=0.9, waited=0.8)
    assert found == FAILED_ALWAYS | dict.fromkeys(OF_TIME, "SKIPPED") | {"test_it_passes": "PASSED"}, said
    assert "the machine was starved: other programs had 90% of" in said


def test_where_the_loop_may_not_go_before_others_lateness_is_told_and_all_else_fails(tmp_path: Path) -> None:
    found, said = outcomes(tmp_path, busy=0.0, waited=0.0, refused="no SCHED_FIFO")
    late = dict.fromkeys(OF_TIME, "SKIPPED") | {"test_it_came_in_time": "FAILED"}  # what never came is not late
    assert found == FAILED_ALWAYS | late | {"test_it_passes": "PASSED"}, said
    assert "the machine was starved: no SCHED_FIFO" in said


def test_a_refused_policy_is_told_and_a_granted_one_is_given_back() -> None:
    before = os.sched_getscheduler(0)
    command = f"import os; os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param({CycleConfig().priority}))"
    may = subprocess.run([sys.executable, "-c", command], stderr=subprocess.DEVNULL).returncode == 0
    assert bool(starved.refused()) != may
    assert os.sched_getscheduler(0) == before


AGAIN = """
import pytest

runs = []

@pytest.mark.serial
def test_a_motion(tmp_path):
    runs.append(tmp_path)
    assert len(runs) == {passes}
    assert len(set(runs)) == {passes}
"""


@pytest.mark.parametrize(
    ("busy", "passes", "found"),
    [(0.9, 1, "PASSED"), (0.9, 3, "PASSED"), (0.9, 4, "FAILED"), (0.0, 1, "PASSED"), (0.0, 2, "FAILED")],
)
def test_a_motion_is_run_again_on_a_starved_machine_alone_and_must_pass_then(
    tmp_path: Path, busy: float, passes: int, found: str
) -> None:
    outcome, said = outcomes(tmp_path, busy, 0.8, AGAIN.format(passes=passes))
    assert outcome == {"test_a_motion": found}, said


ANEW = """
import pytest

made = []

@pytest.fixture(scope="module")
def axis():
    made.append(None)
    if len(made) < 3:
        raise RuntimeError("a fault")
    return len(made)

@pytest.mark.serial
def test_it_moves(axis):
    assert axis == 3

@pytest.mark.serial
def test_it_stands(axis):
    assert axis == 3
"""


@pytest.mark.parametrize(("busy", "found"), [(0.9, "PASSED"), (0.0, "ERROR")])
def test_a_run_again_makes_the_axis_of_its_file_anew(tmp_path: Path, busy: float, found: str) -> None:
    outcome, said = outcomes(tmp_path, busy, 0.8, ANEW)
    assert outcome == {"test_it_moves": found, "test_it_stands": found}, said


@pytest.mark.parametrize(("busy", "waited"), [(0.0, 0.0), (0.2, 0.9), (0.9, 0.05)])
def test_on_an_idle_machine_every_failure_stays_one(tmp_path: Path, busy: float, waited: float) -> None:
    found, said = outcomes(tmp_path, busy, waited)
    assert found == FAILED_ALWAYS | dict.fromkeys(OF_TIME, "FAILED") | {"test_it_passes": "PASSED"}, said


def test_a_test_that_is_not_of_the_wall_clock_is_never_excused(tmp_path: Path) -> None:
    plain = TESTS.replace("pytestmark = pytest.mark.serial", "").replace("@pytest.mark.wall_clock", "")
    found, said = outcomes(tmp_path, 0.9, 0.8, plain)
    assert found == FAILED_ALWAYS | dict.fromkeys(OF_TIME, "FAILED") | {"test_it_passes": "PASSED"}, said


@pytest.mark.parametrize(
    ("error", "excused"),
    [
        (TimeoutError("it did not come"), True),
        (subprocess.TimeoutExpired("demo", 10.0), True),
        (Unreachable("DEADLINE_BUDGET: late; SUPERVISOR_LOST: nobody feeds the loop"), True),
        (Refused("not enabled: FEEDBACK_STALE: no feedback"), True),
        (Unreachable("not enabled: TORQUE_CLIPPED"), False),
        (Unreachable("FOLLOWING_ERROR: too far, FEEDBACK_STALE: no feedback"), False),
        (Unreachable("no daemon answers"), False),
        (BadInput("cycle", 1, "2"), False),
        (AssertionError("FEEDBACK_STALE"), False),
        (ValueError("FEEDBACK_STALE"), False),
    ],
)
def test_only_time_is_excused(error: BaseException, excused: bool) -> None:
    assert by_lateness(error, times_alone=False) == excused


@pytest.mark.parametrize(
    ("faults", "excused"),
    [(["DEADLINE_LATE", "DEADLINE_BUDGET"], True), (["DEADLINE_BUDGET", "SPEED_LIMIT"], False), ([], False)],
)
def test_what_follows_from_a_latched_fault_has_the_excuse_of_that_fault(
    tmp_path: Path, faults: list[str], excused: bool
) -> None:
    (tmp_path / "log").write_text("".join(f"ERROR fault {name} (RAMP_DOWN): why | timing\n" for name in faults))
    found = logged([tmp_path / "log", tmp_path / "none"])
    assert found == set(faults)
    for error in (Refused("refused: a fault is latched; see"), AssertionError("assert 'FAULT' == 'ENABLED'")):
        assert by_lateness(error, times_alone=False, faults=found) == excused
    ended = AssertionError(f"the motion ended with the axis in QUICK_STOPPING: {' '.join(faults)}\nassert 1 == 0")
    assert by_lateness(ended, times_alone=False, faults=found) == excused
    assert not by_lateness(AssertionError("assert 1.2 <= 0.9"), times_alone=False, faults=found)
    assert not by_lateness(KeyError("'FAULT'"), times_alone=False, faults=found)


LEFT = "ERROR fault NODE_LEFT_OPERATIONAL"


@pytest.mark.parametrize(("emcy", "excused"), [(["8130"], True), (["8130", "2310"], False), ([], False)])
def test_a_drive_that_missed_its_master_missed_it_in_time(tmp_path: Path, emcy: list[str], excused: bool) -> None:
    said = "".join(f"ERROR node 1: EMCY 0x{code} Monitoring, register 0x11 (DRIVE_FAULT)\n" for code in emcy)
    (tmp_path / "log").write_text(
        f"{said}ERROR fault DRIVE_FAULT (DISABLE): why | timing\n{LEFT} (QUICK_STOP): why | timing\n"
    )
    error = AssertionError("not off: the axis is DISABLED: DRIVE_FAULT: why. NODE_LEFT_OPERATIONAL: why\nassert 3 == 0")
    assert by_lateness(error, times_alone=False, faults=logged([tmp_path / "log"])) == excused


STALE = "00:01 ERROR fault FEEDBACK_STALE (QUICK_STOP): why | timing\n"
DOWN = "00:02 ERROR fault BUS_DOWN (QUICK_STOP): why | timing\n"
BEGUN, ENDED = "00:00 INFO gain set demo_pd version 1 (pd)\n", "00:01 INFO stopping: braking\n"


@pytest.mark.parametrize(
    ("log", "found"),
    [
        (BEGUN + STALE + ENDED + DOWN, {"FEEDBACK_STALE"}),
        (BEGUN + STALE + DOWN + ENDED, {"FEEDBACK_STALE", "BUS_DOWN"}),
        (BEGUN + ENDED + DOWN + BEGUN + STALE, {"FEEDBACK_STALE"}),
        (BEGUN + ENDED + BEGUN + DOWN, {"BUS_DOWN"}),
    ],
)
def test_what_befalls_a_daemon_that_was_ended_is_no_cause(log: str, found: set[str]) -> None:
    assert written(log) == found
    error = AssertionError(f"{log}servoctl: refused: must be configured again\nassert 3 == 0")
    assert by_lateness(error, times_alone=False, faults=written(str(error))) == ("BUS_DOWN" not in found)


def test_comparisons_of_times_are_excused_where_the_test_says_that_it_makes_no_others() -> None:
    assert by_lateness(AssertionError("12 ms < 10 ms"), times_alone=True)
    assert not by_lateness(ZeroDivisionError(), times_alone=True)


def test_what_the_tests_use_themselves_is_taken_off() -> None:
    before = Reading(10.0, 100.0, 20.0, 5.0)
    assert between(before, Reading(20.0, 118.0, 38.0, 14.0)).others_s == 0.0
    assert between(before, Reading(20.0, 118.0, 21.0, 14.0)).others_s == pytest.approx(17.0)
    assert between(before, Reading(20.0, 118.0, 20.0, None)).waited_s is None


@pytest.mark.parametrize(
    ("others_s", "waited_s", "starved"),
    [
        *((12.0, 5.0, True), (4.0, 5.0, False), (12.0, 0.5, False), (0.0, 10.0, False)),
        *((12.0, None, True), (8.0, None, False)),
    ],
)
def test_both_counts_are_wanted_and_more_of_one_where_there_is_one(
    others_s: float, waited_s: float | None, starved: bool
) -> None:
    assert bool(Span(10.0, 2, others_s, waited_s).starved) == starved


HOLD = """
import os, sys, time
os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(99))
end = time.monotonic() + 0.03
while time.monotonic() < end: pass
"""


def test_a_processor_that_stands_still_is_seen() -> None:
    """By one who may go before all other programs, but for this one, which is not the tests' own either."""
    stalls, first_s = Stalls(), time.monotonic()
    stalls.watch()
    time.sleep(0.5)
    before = stalls.longest_s(first_s, time.monotonic())
    held_s = time.monotonic()
    may = subprocess.run([sys.executable, "-c", HOLD], stderr=subprocess.DEVNULL).returncode == 0
    time.sleep(0.1)
    found = stalls.longest_s(held_s, time.monotonic())
    stalls.end()
    assert found >= 0.025 if may else found == before == 0.0
    began_after = stalls.longest_s(time.monotonic(), time.monotonic() + 1.0)
    assert began_after == found  # it hit an axis that the next test finds
    assert stalls.longest_s(held_s + 60.0, held_s + 61.0) == 0.0


@pytest.mark.parametrize(("stall_s", "starved"), [(0.004, False), (0.027, True)])
def test_a_stand_still_is_evidence_on_an_idle_machine(stall_s: float, starved: bool) -> None:
    assert bool(Span(10.0, 2, 0.0, 0.0, stall_s).starved) == starved


def test_a_span_of_no_time_is_no_evidence() -> None:
    assert Span(0.0, 2, 0.0, 0.0).starved == "" and Span(0.0, 2, 0.0, None).starved == ""


def test_a_tick_of_the_kernels_clock_is_no_evidence() -> None:
    """A fixture of 9 ms in which a tick of 10 ms ended: others had 55 % of two processors, and somebody waited."""
    assert Span(0.009, 2, 0.01, 0.009).starved == ""
    assert Span(0.009, 2, 0.01, 0.009, 0.006).starved != ""


BURN = "import time\nwhile time.process_time() < 0.4: pass\n"


@pytest.mark.parametrize("lives", [False, True])
def test_processor_time_of_children_is_the_tests_own(lives: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of those that have ended, and of those that live, in a session of their own and whoever is their parent.

    In a run of its own: what other tests of this one started may end meanwhile, and its time goes with it.
    """
    monkeypatch.setenv("SERVOD_TEST_RUN", f"{os.getpid()} alone")
    code = BURN + ("print(flush=True)\ntime.sleep(60)" if lives else "print(flush=True)")
    shell = ["sh", "-c", f'"{sys.executable}" -c "$1" & wait', "sh", code]
    first = read()
    child = subprocess.Popen(shell, stdout=subprocess.PIPE, start_new_session=True)
    assert child.stdout is not None and child.stdout.readline() == b"\n"
    if not lives:
        child.wait(30)
    last = read()
    if lives:
        os.killpg(child.pid, 9)
        child.wait(30)
    assert last.own_s - first.own_s > 0.35
    assert last.now_s >= first.now_s and time.monotonic() >= last.now_s
