"""Worker processes end with the process that began them, and none is left behind, not even their accountant."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from servod.common.errors import Unreachable
from servod.common.workers import worker_pool

#: Two workers at work; says so, and leaves the block by Ctrl-C.
WORKS = """
import time
from servod.common.workers import worker_pool

if __name__ == "__main__":
    try:
        with worker_pool(2) as pool:
            pending = [pool.submit(time.sleep, 60) for _ in range(2)]
            print("at work", flush=True)
            pending[0].result()
    except KeyboardInterrupt:
        pass
"""


def in_session(session: int) -> list[str]:
    """Processes of a session as the kernel lists them, also those that ended and were not waited for."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            text = stat.read_text()
        except OSError:
            continue  # it ended meanwhile
        if int(text.rpartition(")")[2].split()[3]) == session:
            found.append(text[:40])
    return found


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_nobody_stays(number: signal.Signals, tmp_path: Path) -> None:
    script = tmp_path / "works.py"
    script.write_text(WORKS)
    with subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, start_new_session=True) as parent:
        assert parent.stdout is not None
        assert parent.stdout.readline() == b"at work\n"
        assert len(in_session(parent.pid)) == 4
        os.killpg(parent.pid, number) if number is signal.SIGINT else parent.send_signal(number)
        parent.wait(30)
        if number is signal.SIGINT:
            assert in_session(parent.pid) == []
        else:
            wait_for(lambda: not in_session(parent.pid))


def wait_for(reached: Callable[[], bool]) -> None:
    """Orphans are waited for by whoever inherits them, in its own time."""
    deadline = time.monotonic() + 20.0
    while not reached():
        assert time.monotonic() < deadline
        time.sleep(0.1)


def kill_the_first_worker() -> None:
    """Wait until a worker has begun, and kill it."""
    wait_for(lambda: bool(multiprocessing.active_children()))
    multiprocessing.active_children()[0].kill()


def test_a_worker_that_is_killed_ends_the_work_in_one_line() -> None:
    killer = threading.Thread(target=kill_the_first_worker)
    with pytest.raises(Unreachable, match="worker process ended"), worker_pool(2) as pool:
        killer.start()
        pool.submit(time.sleep, 60).result()
    killer.join()
    assert multiprocessing.active_children() == []


def test_a_worker_that_dies_at_its_start_ends_the_work() -> None:
    with pytest.raises(Unreachable, match="could not start"), worker_pool(1, os._exit, 3) as pool:
        pool.submit(time.sleep, 60).result()


def test_a_failure_of_the_work_itself_is_raised_as_it_is() -> None:
    with pytest.raises(ZeroDivisionError), worker_pool(1) as pool:
        pool.submit(divmod, 1, 0).result()
