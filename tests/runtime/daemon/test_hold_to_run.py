"""A motion lives by its client: whoever dies, hangs or leaves halts it, unless it was told to go on."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from running import Running, wait_for
from served import Served

from servod.client.control import ControlClient
from servod.formats.protocol import RENEW_S, Verb

#: Starts a long motion, says so, and then does what a test wants of it.
_MOVER = """
import os, sys, time
from servod.client.control import ControlClient
client = ControlClient(sys.argv[1])
client.call("track", kind="sine", amplitude_rad=0.05, frequency_hz=1, duration_s=60)
child = os.fork() if sys.argv[2] == "forks" else 0
if sys.argv[2] == "forks" and child == 0:
    time.sleep(30)
    os._exit(0)
print("moves", child, flush=True)
while sys.argv[2] == "renews":
    client.call("status")
    time.sleep(0.1)
if sys.argv[2] == "hangs":
    time.sleep(30)
os._exit(0)
"""


def _status(axis: Running) -> dict[str, Any]:
    with ControlClient(axis.socket) as client:
        return client.call("status")


def _enable(axis: Running) -> None:
    with ControlClient(axis.socket) as client:
        client.call("enable")


def _moves(mover: subprocess.Popen[bytes]) -> int:
    """Wait until its motion runs; the process that it forked, or 0."""
    assert mover.stdout is not None
    word, child = mover.stdout.readline().split()
    assert word == b"moves"
    return int(child)


def _halted(axis: Running, since: float) -> dict[str, Any]:
    """The status once the motion has ended, which was to be soon."""
    wait_for(lambda: bool(_status(axis)["motion"]["abandoned"]), 5.0)
    if (took_s := time.monotonic() - since) > RENEW_S + 1.0:
        raise TimeoutError(f"the motion ended {took_s:.2f} s after its client")
    wait_for(lambda: not _status(axis)["axis"]["motion_running"], 5.0)
    return _status(axis)


@pytest.mark.parametrize("way", ["dies", "hangs", "forks"])
def test_motion_halts_when_its_client(axis: Running, way: str) -> None:
    _enable(axis)
    child = 0
    with subprocess.Popen([sys.executable, "-c", _MOVER, str(axis.socket), way], stdout=subprocess.PIPE) as mover:
        try:
            child = _moves(mover)
            status = _halted(axis, time.monotonic())
        finally:
            mover.kill()
            if child:
                os.kill(child, signal.SIGKILL)
    assert status["axis"]["state"] == "ENABLED"  # it holds; torque and gravity are another matter
    assert "which started it, has" in status["motion"]["abandoned"]
    assert status["motion"]["abandoned"] in axis.log
    with ControlClient(axis.socket) as client:
        wait_for(lambda: client.call("status")["lease"]["pid"] == 0 or way == "hangs")
        client.call("disable")


def test_motion_that_is_renewed_goes_on_until_its_client_is_stopped(axis: Running) -> None:
    _enable(axis)
    with subprocess.Popen([sys.executable, "-c", _MOVER, str(axis.socket), "renews"], stdout=subprocess.PIPE) as mover:
        try:
            _moves(mover)
            time.sleep(4.0 * RENEW_S)
            assert _status(axis)["axis"]["motion_running"]
            mover.send_signal(signal.SIGSTOP)
            _halted(axis, time.monotonic())
        finally:
            mover.kill()
    with ControlClient(axis.socket) as client:
        client.call("disable")


def test_motion_that_was_told_to_goes_on_without_its_client(axis: Running) -> None:
    with ControlClient(axis.socket) as client:
        client.call("enable")
        client.call("track", kind="sine", amplitude_rad=0.05, frequency_hz=1, duration_s=60, renew_s=None)
    time.sleep(3.0 * RENEW_S)
    status = _status(axis)
    assert (status["axis"]["motion_running"], status["motion"]["abandoned"]) == (True, "")
    with ControlClient(axis.socket) as client:
        client.call("disable")


def test_supervisor_that_was_held_up_blames_no_client(tmp_path: Path) -> None:
    """What a client asked meanwhile waits in its socket: a round that took long is no silence of the client's."""
    served = Served(tmp_path / "axis.sock")
    try:
        served.handler.renew_ns = 300_000_000
        with ControlClient(served.path) as client:
            client.call(Verb.TRACK)
            served.handler.held_up_s = 1.0
            time.sleep(0.1)
            client.call(Verb.STATUS)
            assert served.handler.abandoned == []
            deadline = time.monotonic() + 5.0
            while not served.handler.abandoned and time.monotonic() < deadline:
                time.sleep(0.01)
            assert (
                served.handler.abandoned[0] == f"process {os.getpid()}, which started it, has asked nothing for 0.3 s"
            )
    finally:
        served.close()
