"""Actions on processes and on the machine that they share: signals, load, disks, clients, a second daemon.

Only axes that are processes can show them.
"""

from __future__ import annotations

import contextlib
import os
import resource
import signal
import time
from abc import abstractmethod
from enum import StrEnum
from subprocess import Popen
from typing import TYPE_CHECKING, Any, ClassVar

from pydantic import Field

from servod.client.processes import child, last_core, wait_until
from servod.common.errors import ServodError
from servod.formats.protocol import RENEW_S, Verb
from servod.qualify.faults.actions.base import InjectionAction
from servod.qualify.faults.machine import Process
from servod.qualify.faults.processes import ProcessAxis
from servod.qualify.faults.scenario import Loss, Runs
from servod.runtime.daemon.waiting import STARTS_AGAIN
from servod.runtime.loop.axis_state import AxisState

if TYPE_CHECKING:
    from servod.qualify.faults.under_test import AxisUnderTest

_KIB = 1024
_CLIENT_S = 20.0
#: From the loss to the new bring-up, on the slowest machine (the guest); how often one looks meanwhile.
_RESTART_S, _LOOK_S = 90.0, 0.1
_HELD_UP_S = 0.5


class ProcessAction(InjectionAction):
    """An action for which there must be processes."""

    runs: ClassVar[frozenset[Runs]] = frozenset({Runs.PROCESSES, Runs.GUEST})

    def apply(self, axis: AxisUnderTest) -> None:
        """Let it happen."""
        assert isinstance(axis, ProcessAxis)  # `runs` was checked when the scenario was read
        self.took(axis, self.act(axis))

    @abstractmethod
    def act(self, axis: ProcessAxis) -> int:
        """Let it happen to these processes; returns how often it took effect, by what it left."""


class SignalName(StrEnum):
    """Signals that end, stop or continue a process."""

    SIGKILL = "SIGKILL"
    SIGTERM = "SIGTERM"
    SIGINT = "SIGINT"
    SIGHUP = "SIGHUP"
    SIGSTOP = "SIGSTOP"
    SIGCONT = "SIGCONT"


#: Signals after which a process does no more work; the supervisor may stand still for as long as the loop goes on.
_ENDS = (SignalName.SIGKILL, SignalName.SIGTERM, SignalName.SIGINT, SignalName.SIGHUP)
_TAKES = {
    **{(Process.DAEMON, name): Loss.MASTER for name in _ENDS},
    **{(Process.LOOP, name): Loss.MASTER for name in (*_ENDS, SignalName.SIGSTOP)},
    **{(Process.VIRTUAL_AXIS, name): Loss.FEEDBACK for name in (*_ENDS, SignalName.SIGSTOP)},
}


class Signal(ProcessAction):
    """Processes get a signal; several that are killed die together, none can act on the other's death."""

    traceless: ClassVar[str] = "the process was gone already"

    who: list[Process] = Field(min_length=1)
    signal: SignalName

    def loss(self) -> Loss:
        """By who is hit; of loop and supervisor the drive loses its master."""
        losses = {_TAKES.get((process, self.signal), Loss.NONE) for process in self.who}
        return next((loss for loss in (Loss.FEEDBACK, Loss.MASTER) if loss in losses), Loss.NONE)

    def act(self, axis: ProcessAxis) -> int:
        """Send it; who runs cannot refuse it."""
        return axis.signal(self.who, signal.Signals[self.signal])


class VirtualAxisBack(ProcessAction):
    """Amplifier and encoder get their supply back."""

    def act(self, axis: ProcessAxis) -> int:
        """Start them, until they serve."""
        axis.machine.wait(Process.VIRTUAL_AXIS, 5.0)
        axis.machine.start_virtual_axis()
        return 1


class AwaitRestart(ProcessAction):
    """Bus and nodes are back: the daemon brings the axis up again by itself, DISABLED, and was in FAULT until then.

    It may do so before anybody looks: nodes are back before their start has told so. That it did, the log says.
    """

    traceless: ClassVar[str] = "the axis did not go from FAULT to DISABLED by itself, or was enabled"

    def act(self, axis: ProcessAxis) -> int:
        """Watch it until its fault is gone, without a command."""
        axis.leave()
        states: list[str] = []
        deadline = time.monotonic() + _RESTART_S
        while time.monotonic() < deadline:
            with contextlib.suppress(ServodError), axis.machine.client() as client:
                status = client.call(Verb.STATUS)
                states.append(status["axis"]["state"])
                if states[-1] != AxisState.FAULT.name and not status["faults"]:
                    break
            time.sleep(_LOOK_S)
        while states and states[0] == AxisState.QUICK_STOPPING.name:  # a drive that is not heard is told for a while
            states.pop(0)
        others = [state for state in states if state != AxisState.FAULT.name]
        return others == [AxisState.DISABLED.name] and STARTS_AGAIN in axis.machine.daemon_log()


class RestartDaemon(ProcessAction):
    """Somebody restarts the service."""

    def loss(self) -> Loss:
        """For the time between."""
        return Loss.MASTER

    def act(self, axis: ProcessAxis) -> int:
        """SIGTERM, wait, start, until it answers."""
        axis.restart_daemon()
        return 1


class SecondDaemon(ProcessAction):
    """Somebody starts a second daemon for the same axis."""

    def act(self, axis: ProcessAxis) -> int:
        """Start it and see how it ends."""
        axis.second_daemon()
        return 1


class Ask(ProcessAction):
    """A person asks the daemon for something; a refusal is kept."""

    verb: Verb
    args: dict[str, Any] = Field({})

    def act(self, axis: ProcessAxis) -> int:
        """Ask; a refusal is an answer, which the judge sees."""
        axis.call(self.verb, **self.args)
        return 1


class ClientKilled(ProcessAction):
    """`servoctl track` moves the axis, and is killed in the middle."""

    def act(self, axis: ProcessAxis) -> int:
        """Start it, wait until the axis moves, kill it."""
        client = _moving_client(axis)
        client.kill()
        return client.wait() == -signal.SIGKILL


class ClientStopped(ProcessAction):
    """`servoctl track` moves the axis, and stands still in the middle: it keeps its connection, and its command."""

    def act(self, axis: ProcessAxis) -> int:
        """Start it, wait until the axis moves, stop it."""
        axis.stopped_client = client = _moving_client(axis)
        client.send_signal(signal.SIGSTOP)
        changed = os.waitid(os.P_PID, client.pid, os.WSTOPPED | os.WEXITED | os.WNOWAIT)
        return changed is not None and changed.si_code == os.CLD_STOPPED


class MotionHalts(ProcessAction):
    """The motion that nobody renews comes to rest by itself, and the axis holds."""

    traceless: ClassVar[str] = "the motion of a client that is gone went on"

    def act(self, axis: ProcessAxis) -> int:
        """Look on until it has; half a second, braking, and what a machine that others use takes."""
        deadline = time.monotonic() + RENEW_S + axis.config.limits.ramp_down_s + _HELD_UP_S
        while _moves(axis) and time.monotonic() < deadline:
            time.sleep(_LOOK_S)
        with axis.machine.client() as client:
            status = client.call(Verb.STATUS)
        halted = bool(status["motion"]["abandoned"]) and not status["axis"]["motion_running"]
        return halted and status["axis"]["state"] == AxisState.ENABLED.name


class StoppedClientEnds(ProcessAction):
    """Somebody ends the client that stands still."""

    def act(self, axis: ProcessAxis) -> int:
        """Kill it."""
        assert axis.stopped_client is not None
        axis.stopped_client.kill()
        return axis.stopped_client.wait() == -signal.SIGKILL


class CpuLoad(ProcessAction):
    """A program of higher priority takes the loop's core again and again."""

    busy_ms: int = Field(ge=1, le=500)
    idle_ms: int = Field(ge=1, le=500)
    for_ms: int = Field(ge=1, le=5000)

    def loss(self) -> Loss:
        """A loop that gets less than half of its core stands still more than it runs."""
        return Loss.MASTER if self.busy_ms >= self.idle_ms else Loss.NONE

    def act(self, axis: ProcessAxis) -> int:
        """Run it to its end."""
        core = axis.config.cycle.cpu
        numbers = (self.busy_ms, self.idle_ms, self.for_ms, last_core() if core is None else core)
        log = axis.folder / "load.log"
        with child(
            "servod.qualify.faults.cpu_load", [str(number) for number in numbers if number is not None], log
        ) as load:
            return load.wait(_CLIENT_S) == 0


class DiskFull(ProcessAction):
    """No file of the daemon grows beyond a size any more; the limit stands for the disk's end (setrlimit(2))."""

    kib: int = Field(64, ge=16)

    def act(self, axis: ProcessAxis) -> int:
        """Limit it."""
        daemon = axis.machine.daemon
        assert daemon is not None
        _, hard = resource.prlimit(daemon.pid, resource.RLIMIT_FSIZE)
        resource.prlimit(daemon.pid, resource.RLIMIT_FSIZE, (self.kib * _KIB, hard))
        return resource.prlimit(daemon.pid, resource.RLIMIT_FSIZE)[0] == self.kib * _KIB


class RecordingsReadOnly(ProcessAction):
    """Somebody took the right to write from the folder of the recordings."""

    def act(self, axis: ProcessAxis) -> int:
        """Take it."""
        folder = axis.config.recorder.directory
        folder.mkdir(exist_ok=True)
        folder.chmod(0o555)
        return not folder.stat().st_mode & 0o222


def _moving_client(axis: ProcessAxis) -> Popen[bytes]:
    """`servoctl track`, while the axis moves by it; it ends with the axis under test at the latest."""
    axis.leave()
    log = axis.folder / "client.log"
    motion = ["sine", "--amplitude", "0.2", "--frequency", "1", "--duration", "60"]
    client = axis.machine.keep(child("servod.cli", ["track", *motion, "--socket", str(axis.machine.socket)], log))
    wait_until(lambda: _moves(axis), client, log, _CLIENT_S)
    time.sleep(0.3)
    return client


def _moves(axis: ProcessAxis) -> bool:
    with axis.machine.client() as client:
        return bool(client.call(Verb.STATUS)["axis"]["motion_running"])


PROCESS_ACTIONS: dict[str, type[InjectionAction]] = {
    "signal": Signal,
    "virtual_axis_back": VirtualAxisBack,
    "begins_anew": AwaitRestart,
    "restart_daemon": RestartDaemon,
    "second_daemon": SecondDaemon,
    "ask": Ask,
    "client_killed": ClientKilled,
    "client_stopped": ClientStopped,
    "motion_halts": MotionHalts,
    "stopped_client_ends": StoppedClientEnds,
    "cpu_load": CpuLoad,
    "disk_full": DiskFull,
    "recordings_read_only": RecordingsReadOnly,
}
