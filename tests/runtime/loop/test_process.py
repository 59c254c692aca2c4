"""When the loop process takes its supervisor for lost: beats that stand still, and those that never began."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any, cast

import pytest

from servod.common.units import NS_PER_S
from servod.runtime.loop.channel import Channel
from servod.runtime.loop.handle import LoopHandle
from servod.runtime.loop.plan import LoopPlan
from servod.runtime.loop.process import FIRST_BEAT_S, SUPERVISOR_TIMEOUT_S, supervisor_watch
from tests.runtime.loop.test_channel import Hand


def test_a_supervisor_that_opens_its_sockets_is_waited_for_and_one_that_hangs_later_is_not():
    clock = Hand()
    supervisor = Channel(clock=clock)
    loop = Channel(os.dup(supervisor.fd), clock)
    alive = supervisor_watch(loop, clock, os.getppid())

    def alive_after(quiet_s: float) -> bool:
        clock.ns += round(quiet_s * NS_PER_S)
        return alive()

    assert alive_after(FIRST_BEAT_S - 0.01)
    supervisor.beat()
    assert alive_after(0.0)
    assert alive_after(SUPERVISOR_TIMEOUT_S - 0.01)
    assert not alive_after(0.02)
    supervisor.beat()
    assert alive_after(0.0)


def test_a_supervisor_that_never_begins_is_lost():
    clock = Hand()
    alive = supervisor_watch(Channel(clock=clock), clock, os.getppid())
    clock.ns += round((FIRST_BEAT_S + 0.01) * NS_PER_S)
    assert not alive()


def test_a_supervisor_that_died_while_this_process_began_is_lost_at_once():
    clock = Hand()
    assert not supervisor_watch(Channel(clock=clock), clock, os.getppid() + 1)()


#: The loop's process, whose cycles end in an error and which says at its end how it is scheduled.
BROKEN = """
import atexit, os, sys
from servod.runtime.loop import process

class Cycle:
    shut_down = lambda *_: None
    let_go = lambda *_: print("let_go")

def run(cycle, clock):
    print(os.sched_getscheduler(0) == os.SCHED_FIFO)
    raise RuntimeError("a cycle that ends in an error")

def refused(*_):
    raise PermissionError

atexit.register(lambda: print(os.sched_getscheduler(0) == os.SCHED_FIFO))
process._plan_in_time = lambda: None
process.LoopPlan = type("Plan", (), {"from_json": lambda _: process.LoopPlan, "config": type("Config", (), {
    "bus": None, "cycle": type("Settings", (), {"cpu": None, "priority": 1})})})
process.Channel = type("Channel", (), {"__init__": lambda *_: None, "publish_ready": lambda *_: None})
process.open_bus = process.supervisor_watch = lambda *_: None
process.Cycle, process.run = (lambda *_: Cycle()), run
if "unready" in sys.argv:
    process.Channel.publish_ready = refused
if "refused" in sys.argv:
    os.sched_setscheduler = refused
process.main()
"""


@pytest.mark.parametrize("more", [(), ("refused",)], ids=["granted", "refused"])
def test_a_loop_whose_cycles_end_in_an_error_lets_others_run(more: tuple[str, ...]) -> None:
    """At its end it is no real-time process any more, and the error is what is told, not that this was refused."""
    command = [sys.executable, "-c", BROKEN, "0", str(os.getpid()), *more]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    during, drive, after = done.stdout.split()
    assert (drive, after) == ("let_go", "False")
    assert during == "False" or not more
    assert done.stderr.rstrip().endswith("RuntimeError: a cycle that ends in an error")
    assert "PermissionError" not in done.stderr


def test_a_loop_that_fails_before_its_first_cycle_takes_the_drive_off_torque() -> None:
    command = [sys.executable, "-c", BROKEN, "0", str(os.getpid()), "unready"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.stdout.split() == ["let_go", "False"]
    assert done.stderr.rstrip().endswith("PermissionError")


#: In place of the loop: ready half a second after its start.
CHILD = """
import sys, time
from servod.runtime.loop.channel import Channel
sys.stdin.read()
channel = Channel(int(sys.argv[1]))
time.sleep(0.5)
channel.publish_ready([])
"""


class _Plan:
    def to_json(self) -> str:
        return "{}"


@pytest.fixture
def late_child(monkeypatch: pytest.MonkeyPatch) -> None:
    """The loop's process is one that is ready after half a second, and does no more."""
    popen = subprocess.Popen

    def child(command: list[str], **options: Any) -> subprocess.Popen[str]:
        return popen([sys.executable, "-c", CHILD, command[-2]], **options)

    monkeypatch.setattr(subprocess, "Popen", child)


@pytest.mark.usefixtures("late_child")
def test_a_look_that_took_long_is_told_that_the_loop_began() -> None:
    """What it hears then may be the loop's own."""
    loop, told = LoopHandle(cast(LoopPlan, _Plan())), []
    before_ns = time.monotonic_ns()

    def look(began_ns: Callable[[], int | None]) -> None:
        told.append(began_ns())
        time.sleep(2.0)
        told.append(began_ns())

    loop.start(look)
    loop.close()
    assert told[0] is None
    assert told[-1] is not None and 0.4e9 < told[-1] - before_ns < 30e9


@pytest.mark.usefixtures("late_child")
def test_the_start_of_the_loop_is_no_beat_yet() -> None:
    """Else the shorter patience would begin before the supervisor's rounds do."""
    loop, looks = LoopHandle(cast(LoopPlan, _Plan())), []
    before = loop._channel.supervisor_beats()
    loop.start(lambda _: looks.append(loop._channel.supervisor_beats()))
    assert len(looks) > 2
    assert {*looks, loop._channel.supervisor_beats()} == {before}
    loop.feed()
    assert loop._channel.supervisor_beats() != before
    loop.close()


def test_a_supervisor_that_stands_still_before_it_wrote_the_plan_is_not_waited_for_without_end() -> None:
    code = "from servod.runtime.loop import process; process.FIRST_BEAT_S = 0.2; process.main()"
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE) as loop:
        assert loop.wait(30.0) == -signal.SIGALRM
