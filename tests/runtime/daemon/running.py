"""A real daemon on a real virtual axis, both processes of their own, in a folder of their own."""

from __future__ import annotations

import contextlib
import socket
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from subprocess import Popen
from typing import Generic, Protocol, TypeVar

import pytest

from servod.client.control import ControlClient, Refused
from servod.client.processes import child, wait_until
from servod.common.errors import Unreachable
from servod.common.faults import NEEDS_RESTART
from servod.common.shipped import shipped
from tests.starved import LOGS

CONFIG = """
name: tried
bus: {{interface: virtual, channel: {folder}/bus}}
cycle: {{feedback_timeout_us: 800}}
limits:
  torque_nm: 0.9
  torque_rate_nm_per_s: 400.0
  speed_rad_s: 5.0
  position_min_rad: -{travel_rad}
  position_max_rad: {travel_rad}
  following_error_rad: 0.3
  encoder_mismatch_rad: 0.05
  stale_cycles: 200           # behaviour is tested here, on machines that may be busy
  late_cycles: 500
gains: {{directory: {folder}/gains, initial: {gains}, accept_uncertified: true}}
control: {{socket: {folder}/axis.sock}}
recorder: {{directory: {folder}/recordings, history_s: 2.0}}
metrics: {{textfile: {folder}/axis.prom}}
"""


@dataclass
class Running:
    """Both processes, and what the daemon told the service manager."""

    folder: Path
    axis: Popen[bytes]
    daemon: Popen[bytes]
    manager: socket.socket

    @property
    def socket(self) -> Path:
        """Path of the control socket."""
        return self.folder / "axis.sock"

    @property
    def log(self) -> str:
        """The daemon's log so far."""
        return (self.folder / "daemon.log").read_text()

    def told(self) -> list[str]:
        """Messages to the service manager since the last call."""
        messages = []
        with contextlib.suppress(BlockingIOError):
            while True:
                messages.append(self.manager.recv(4096).decode())
        return messages


@contextlib.contextmanager
def running(folder: Path, plant: Path | None = None, more: str = "", travel_rad: float = 0.6) -> Iterator[Running]:
    """Start both, wait until the daemon answers, and leave nothing behind.

    `plant` is another joint than the demo's, `more` further sections of the configuration.
    """
    config = folder / "axis.yaml"
    initial = shipped("gains/demo_pd.yaml")
    config.write_text(CONFIG.format(folder=folder, gains=initial, travel_rad=travel_rad) + more)
    joint = ["--plant", str(plant)] if plant else []
    log = folder / "daemon.log"
    LOGS.append(log)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as manager:
        manager.bind(str(folder / "notify"))
        with child(
            "servod.drivers.virtual.main", ["--socket", str(folder / "bus"), *joint], folder / "axis.log"
        ) as axis:
            wait_until((folder / "bus").exists, axis, folder / "axis.log", 30.0)
            with (
                told_to(folder / "notify"),
                child("servod.runtime.daemon.main", ["--config", str(config)], log) as daemon,
            ):
                wait_until(lambda: answers(folder / "axis.sock"), daemon, log, 30.0)
                yield Running(folder, axis, daemon, manager)


def answers(path: Path) -> bool:
    """Whether there is a status: the socket is there before the loop has begun."""
    try:
        with ControlClient(path) as client:
            client.call("status")
    except (Unreachable, Refused):
        return False
    return True


@contextlib.contextmanager
def told_to(notify: Path) -> Iterator[None]:
    """Children started in this block take `notify` for the service manager, with a watchdog of 0.4 s."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("NOTIFY_SOCKET", str(notify))
        patch.setenv("WATCHDOG_USEC", "400000")
        yield


def wait_for(reached: Callable[[], bool], timeout_s: float = 10.0) -> None:
    """Wait until `reached()`."""
    deadline = time.monotonic() + timeout_s
    while not reached():
        if time.monotonic() > deadline:
            raise TimeoutError("it did not come")
        time.sleep(0.02)


def at_rest(client: ControlClient) -> Callable[[], bool]:
    """Whether no motion runs any more; raises Unreachable with the faults when one of them ended it."""

    def rests() -> bool:
        status = client.call("status")
        if status["axis"]["state"] == "FAULT":
            raise Unreachable("the axis stopped: " + ", ".join(fault["code"] for fault in status["faults"]))
        return not status["axis"]["motion_running"]

    return rests


class HasSocket(Protocol):
    """What runs, as far as a shared axis asks."""

    @property
    def socket(self) -> Path:
        """Its control socket."""
        ...


_T = TypeVar("_T", bound=HasSocket)


class SharedAxis(Generic[_T]):
    """A daemon on a virtual axis, for one test after the other.

    A machine that stands still for a tenth of a second leaves a drive that only a new start brings up; the test that it
    hit says so, and the next one, or its second try, begins on a new axis.
    """

    def __init__(self, begin: Callable[[], contextlib.AbstractContextManager[_T]]) -> None:
        """`begin` starts one; the first `stands` calls it."""
        self._begin, self._held = begin, contextlib.ExitStack()
        self._runs: _T | None = None

    def close(self) -> None:
        """End the daemon."""
        self._held.close()

    def stands(self) -> _T:
        """What runs, on an axis that can be enabled. A new one is told of; a daemon that is gone is not replaced."""
        if self._runs is not None and (lost := _needs_restart(self._runs.socket)):
            warnings.warn(pytest.PytestWarning(f"a new axis, the last one needs a new start: {lost}"), stacklevel=2)
            self.close()
            self._runs = None
        if self._runs is None:
            self._runs = self._held.enter_context(self._begin())
        return self._runs


def _needs_restart(control: Path) -> str:
    """The faults that do, or nothing."""
    with ControlClient(control) as client:
        told = {fault["code"] for fault in client.call("status")["faults"]}
    return ", ".join(code.name for code in NEEDS_RESTART if code.name in told)
