"""Child processes that never outlive their parent: daemon and virtual axis of the demo and of the benchmark.

Beside the data path. Each child gets SIGTERM from the kernel when the parent dies in any way (prctl), and is stopped
and waited for when the block that started it ends, in whatever way it ends.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import yaml

from servod.client.control import ControlClient
from servod.common.end_signals import END_SIGNALS
from servod.common.errors import Unreachable
from servod.common.portable import need_linux
from servod.formats.config import AxisConfig

_PR_SET_PDEATHSIG, _PR_CAPBSET_DROP = 1, 24  # linux/prctl.h
_STOP_S = 5.0
#: A socket's path (sockaddr_un.sun_path, unix(7)), and what of it the letters of a temporary folder's name and the
#: name of a socket in it take.
_SOCKET_PATH_BYTES, _ENDING_BYTES = 107, len("/12345678/axis.socket")


def socket_folder(prefix: str) -> tempfile.TemporaryDirectory[str]:
    """A temporary folder for sockets: where TMPDIR is too long for a socket's path, it is in /tmp."""
    usual = tempfile.gettempdir()
    fits = len(os.fsencode(f"{usual}{prefix}")) + _ENDING_BYTES <= _SOCKET_PATH_BYTES
    return tempfile.TemporaryDirectory(prefix=prefix, dir=usual if fits else "/tmp")  # noqa: S108 - made for its owner


@contextlib.contextmanager
def child(
    module: str, arguments: Sequence[str], log: Path, cores: set[int] | None = None, dropped: Sequence[int] = ()
) -> Iterator[subprocess.Popen[bytes]]:
    """Run `python -m module arguments` for the time of a `with` block; its output goes to `log`.

    `cores` keeps it to these; `dropped` are capabilities (linux/capability.h) that it shall not have.
    """
    need_linux(f"python -m {module}")
    libc = ctypes.CDLL(None)

    def prepare() -> None:
        libc.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
        signal.signal(signal.SIGHUP, signal.SIG_DFL)  # ignored where the parent runs under nohup(1)
        if cores:
            os.sched_setaffinity(0, cores)
        for capability in dropped:
            libc.prctl(_PR_CAPBSET_DROP, capability)

    with log.open("wb") as output:
        process = subprocess.Popen(
            [sys.executable, "-m", module, *arguments],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,  # Ctrl-C is for the parent, which stops the axis in the right order
            preexec_fn=prepare,  # noqa: PLW1509  (one thread; only system calls)
        )
    try:
        yield process
    finally:
        _stop(process)


def _stop(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(_STOP_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def wait_until(ready: Callable[[], bool], process: subprocess.Popen[bytes], log: Path, timeout_s: float) -> None:
    """Wait until `ready()`; raises Unreachable with the last line of `log` when the process ends or time is up."""
    deadline = time.monotonic() + timeout_s
    while not ready():
        if process.poll() is not None or time.monotonic() > deadline:
            lines = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
            raise Unreachable(f"{log.stem} did not start: {lines[-1] if lines else 'no output'}")
        time.sleep(0.02)


@contextlib.contextmanager
def sigterm_as_interrupt() -> Iterator[None]:
    """Let SIGTERM and SIGHUP end the block as Ctrl-C does, so that everything in it is cleaned up.

    Once: a terminal that closes sends SIGHUP twice, by the kernel and by the shell; cleaning up must not end half-way.
    Under nohup(1), SIGHUP stays ignored.
    """

    def interrupt(number: int, _frame: object) -> None:
        for other in before:
            signal.signal(other, signal.SIG_IGN)
        raise KeyboardInterrupt(signal.Signals(number).name)

    handlers = {number: signal.getsignal(number) for number in END_SIGNALS}
    before = {n: h for n, h in handlers.items() if not (n.name == "SIGHUP" and h == signal.SIG_IGN)}
    for number in before:
        signal.signal(number, interrupt)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


_START_S = 20.0


class RunningAxis(NamedTuple):
    """A client that may command, and the daemon's process id."""

    client: ControlClient
    daemon_pid: int


@contextlib.contextmanager
def running_axis(
    config: AxisConfig, plant: Path, folder: Path, axis_options: Sequence[str] = ()
) -> Iterator[RunningAxis]:
    """Virtual axis and daemon for the time of a `with` block. Raises Unreachable when one does not start.

    `axis_options` are further arguments of servod-virtual-axis.
    """
    file = folder / "axis.yaml"
    file.write_text(yaml.safe_dump(config.model_dump(mode="json")), encoding="utf-8")
    bus, control = Path(config.bus.channel), config.control.socket
    with contextlib.ExitStack() as stack:
        log = folder / "virtual-axis.log"
        axis = stack.enter_context(
            child(
                "servod.drivers.virtual.main",
                ["--socket", str(bus), "--plant", str(plant), *axis_options],
                log,
                cores=other_cores(),
            )
        )
        wait_until(bus.exists, axis, log, _START_S)
        log = folder / "servod.log"
        daemon = stack.enter_context(child("servod.runtime.daemon.main", ["--config", str(file)], log))
        wait_until(lambda: _answers(control), daemon, log, _START_S)
        yield RunningAxis(stack.enter_context(ControlClient(control)), daemon.pid)


def _answers(control: Path) -> bool:
    """The daemon listens, and its loop turns."""
    try:
        with ControlClient(control) as client:
            return bool(client.call("status"))
    except Unreachable:
        return False


def last_core() -> int | None:
    """The core farthest from where the system puts its interrupts; None where there is only one."""
    if sys.platform != "linux":
        return None
    cores = sorted(os.sched_getaffinity(0))
    return cores[-1] if len(cores) > 1 else None


def other_cores() -> set[int] | None:
    """All cores but the loop's; None where there is only one."""
    if sys.platform != "linux":
        return None
    return os.sched_getaffinity(0) - {last_core()} or None


def own_group() -> str:
    """The group of this process, by name where it has one."""
    if sys.platform == "win32":
        return "servod"
    import grp

    try:
        return grp.getgrgid(os.getgid()).gr_name
    except KeyError:
        return str(os.getgid())
