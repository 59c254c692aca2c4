"""`servoctl status --watch --json`: JSON Lines until Ctrl-C or until the daemon goes."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.runtime.daemon.served import Served


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Served]:
    server = Served(tmp_path / "axis.sock")
    yield server
    server.close()


@pytest.fixture
def watcher(served: Served) -> Iterator[subprocess.Popen[str]]:
    words = ["status", "--watch", "--json", "--socket", str(served.path)]
    command = [sys.executable, "-m", "servod.cli", *words]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        yield process
        process.kill()


def documents(watcher: subprocess.Popen[str], count: int) -> list[float]:
    assert watcher.stdout is not None
    return [json.loads(watcher.stdout.readline())["now"] for _ in range(count)]


def test_each_refresh_is_a_document_in_a_line_until_ctrl_c(watcher: subprocess.Popen[str]) -> None:
    times = documents(watcher, 4)
    assert times == sorted(set(times))
    watcher.send_signal(signal.SIGINT)
    rest, errors = watcher.communicate(timeout=10)
    assert (watcher.returncode, errors) == (0, "")
    assert all(json.loads(line) for line in rest.splitlines())


def test_a_daemon_that_goes_ends_it(watcher: subprocess.Popen[str], served: Served) -> None:
    documents(watcher, 1)
    served.close("servod was asked to end")
    _, errors = watcher.communicate(timeout=10)
    assert (watcher.returncode, errors.count("\n"), "asked to end" in errors) == (3, 1, True)
