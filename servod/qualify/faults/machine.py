"""Daemon, loop and virtual axis as separate processes in a folder of their own, for scenarios that stop and kill them.

Below `processes`. Everything that was started here ends with `close`, in whatever state it is by then.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from subprocess import Popen

from servod.client.control import ControlClient
from servod.client.processes import child, other_cores, wait_until
from servod.common.errors import ServodError
from servod.drivers.virtual.drive_record import DriveSample, read_drive_record
from servod.formats.protocol import Verb
from servod.qualify.faults.wire import Wire

START_S = 30.0
#: linux/capability.h: passing by the mode bits of files, which the unit takes from the daemon as well.
_PASS_BY_MODES = (1, 2)


class Process(StrEnum):
    """The processes of one axis."""

    DAEMON = "daemon"  # the supervisor
    LOOP = "loop"
    VIRTUAL_AXIS = "virtual_axis"


class Machine:
    """The processes in `folder` (plant.yaml, settings.yaml and axis.yaml stand there), and the ways to look at them."""

    def __init__(self, folder: Path, wire: Wire, waits: bool = False) -> None:
        """With `waits` the daemon waits for bus and nodes, and begins again after their loss."""
        self.folder, self.wire, self._waits = folder, wire, waits
        self.config = folder / "axis.yaml"
        self.socket = folder / "axis.sock"
        self.virtual_axis: Popen[bytes] | None = None
        self.daemon: Popen[bytes] | None = None
        self._loop_fd: int | None = None
        self._starts = 0
        self._stack = contextlib.ExitStack()

    def start_virtual_axis(self) -> None:
        """Start it and wait until it serves; each start has a record and a log of its own. Raises Unreachable."""
        log, record = self._new("axis.log"), self._new("drive.bin")
        files = ("--plant", self.folder / "plant.yaml", "--settings", self.folder / "settings.yaml", "--record", record)
        options = [*self.wire.axis_options(), *map(str, files)]
        self.virtual_axis = self._stack.enter_context(
            child("servod.drivers.virtual.main", options, log, cores=other_cores())
        )
        wait_until(lambda: b"ready " in log.read_bytes(), self.virtual_axis, log, START_S)

    def start_daemon(self) -> None:
        """Start it and wait until it answers. Raises Unreachable with its last line when it ends instead."""
        log = self._new("daemon.log")
        self.daemon = self.daemon_process(log)
        wait_until(self._answers, self.daemon, log, START_S)
        self._close_loop_fd()
        self._loop_fd = os.pidfd_open(_child_of(self.daemon.pid))

    def stop_daemon(self) -> None:
        """Ask it to end, and wait for that."""
        self.send([Process.DAEMON], signal.SIGTERM)
        self.wait(Process.DAEMON, 10.0)

    def daemon_process(self, log: Path) -> Popen[bytes]:
        """One more daemon of this axis; whoever starts it waits for it."""
        arguments = ["--config", str(self.config), *(["--wait"] if self._waits else [])]
        return self._stack.enter_context(child("servod.runtime.daemon.main", arguments, log, dropped=_PASS_BY_MODES))

    def keep(self, process: contextlib.AbstractContextManager[Popen[bytes]]) -> Popen[bytes]:
        """Let a further process live until `close` at the latest."""
        return self._stack.enter_context(process)

    def alive(self, who: Process) -> bool:
        """Whether it runs, stopped or not."""
        if who is Process.LOOP:
            return self._loop_fd is not None and not select.select((self._loop_fd,), (), (), 0.0)[0]
        process = self.daemon if who is Process.DAEMON else self.virtual_axis
        return process is not None and process.poll() is None

    def send(self, who: Sequence[Process], number: signal.Signals) -> None:
        """Signal all of them; those that shall die die together: none can act on another's death."""
        if len(who) > 1 and number is signal.SIGKILL:
            self.send(who, signal.SIGSTOP)
        for process in who:
            self._send_one(process, number)

    def wait(self, who: Process, timeout_s: float) -> int:
        """Exit code of the daemon or the virtual axis."""
        process = self.daemon if who is Process.DAEMON else self.virtual_axis
        assert process is not None
        return process.wait(timeout_s)

    def client(self) -> ControlClient:
        """A connection to the daemon. Raises Unreachable."""
        return ControlClient(self.socket, timeout_s=20.0)

    def drive_samples(self) -> list[DriveSample]:
        """The drive's own record, whoever died; of all starts, one behind the other."""
        return [sample for path in self._all("drive.bin") for sample in read_drive_record(path)]

    def daemon_log(self) -> str:
        """What all daemons of this axis said."""
        return "".join(path.read_text(errors="replace") for path in self._all("daemon.log"))

    def close(self) -> None:
        """End everything, first what could bring the axis to rest; the stopped ones too."""
        if self._loop_fd is not None:
            self.send([Process.LOOP], signal.SIGCONT)
        for who in (Process.DAEMON, Process.VIRTUAL_AXIS):
            if self.alive(who):
                self.send([who], signal.SIGCONT)
        if self.alive(Process.DAEMON):
            self.send([Process.DAEMON], signal.SIGTERM)
            with contextlib.suppress(TimeoutError, OSError, ValueError):
                self.wait(Process.DAEMON, 5.0)
        self._send_one(Process.LOOP, signal.SIGKILL)
        self._close_loop_fd()
        self._stack.close()

    def _send_one(self, who: Process, number: signal.Signals) -> None:
        """One that is gone already needs no signal any more."""
        if who is not Process.LOOP:
            process = self.daemon if who is Process.DAEMON else self.virtual_axis
            if process is not None:
                process.send_signal(number)
        elif self._loop_fd is not None:
            with contextlib.suppress(ProcessLookupError):
                signal.pidfd_send_signal(self._loop_fd, number)

    def _answers(self) -> bool:
        try:
            with self.client() as client:
                return bool(client.call(Verb.STATUS))
        except ServodError:
            return False

    def _close_loop_fd(self) -> None:
        if self._loop_fd is not None:
            os.close(self._loop_fd)
        self._loop_fd = None

    def _new(self, name: str) -> Path:
        self._starts += 1
        return self.folder / f"{self._starts:02d}-{name}"

    def _all(self, name: str) -> list[Path]:
        return sorted(self.folder.glob(f"[0-9][0-9]-{name}"))


def _child_of(pid: int) -> int:
    """The only child of a process (proc(5), task/children)."""
    (only,) = Path(f"/proc/{pid}/task/{pid}/children").read_text(encoding="utf-8").split()
    return int(only)
