"""The supervisor's handle on the loop process: start, commands in, records out, and how it ended."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence

from servod.common.errors import BadInput, Unreachable
from servod.common.files import reason
from servod.formats.recording.record import CycleRecord
from servod.runtime.loop.channel import MAX_ARGUMENTS, TRAJECTORY_SAMPLES, Channel
from servod.runtime.loop.commands import Op
from servod.runtime.loop.plan import LoopPlan
from servod.runtime.loop.realtime import Grant
from servod.runtime.loop.wiring.findings import WiringReport

START_TIMEOUT_S = 10.0
_ASK_AGAIN_S = 0.5
#: A process that was killed is gone in this time, unless the kernel holds it: the axis is not to wait for that.
_KILLED_S = 0.2


class LoopHandle:
    """One loop process. Not thread-safe; once `feed` was called, it must be at least ten times a second."""

    def __init__(self, plan: LoopPlan) -> None:
        """Nothing is started yet."""
        self.plan = plan
        self.latest: CycleRecord | None = None
        self._channel = Channel()
        self._process: subprocess.Popen[str] | None = None

    def start(self, meanwhile: Callable[[Callable[[], int | None]], None] = lambda _: None) -> None:
        """Start the process and wait for its first cycle; raises Unreachable with its last words when it dies.

        `meanwhile` is done again and again until then; what it raises ends the start. It is given what tells when
        the loop began, None before.
        """
        fd = self._channel.fd
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "servod.runtime.loop.process", str(fd), str(os.getpid())],
                stdin=subprocess.PIPE,
                stderr=subprocess.PIPE,
                pass_fds=(fd,),
                text=True,
            )
        except OSError as error:  # a limit on open files or processes
            raise Unreachable(f"the loop process cannot be started ({reason(error)}); see `ulimit -a`") from None
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # what it died of is told below
            self._process.stdin.write(self.plan.to_json())
            self._process.stdin.close()
        self._wait_until_ready(meanwhile)

    @property
    def pid(self) -> int:
        """Process id of the loop; 0 before the start."""
        return self._process.pid if self._process else 0

    @property
    def grants(self) -> list[Grant]:
        """What the operating system granted the loop."""
        return self._channel.grants()

    @property
    def proofs(self) -> tuple[int, WiringReport | None]:
        """How many tests of the wiring have ended since the start, and how the last one did."""
        return self._channel.proofs()

    @property
    def lost(self) -> int:
        """Records that were overwritten before they were read."""
        return self._channel.lost

    @property
    def exit_code(self) -> int | None:
        """None while the process runs."""
        return self._process.poll() if self._process else None

    def alive(self) -> bool:
        """The process runs."""
        return self._process is not None and self._process.poll() is None

    def feed(self) -> None:
        """The supervisor lives; the loop stops the axis when this stays away."""
        self._channel.beat()

    def send(self, op: Op, arguments: Sequence[float] = ()) -> int:
        """Queue a command and return its number; the record's `command_seq` shows when it was carried out."""
        if len(arguments) > MAX_ARGUMENTS:
            raise BadInput(f"command {op.name}", f"{len(arguments)} arguments", f"at most {MAX_ARGUMENTS}")
        number = self._channel.send(op, arguments)
        if not number:
            raise Unreachable("the loop does not take commands: its queue is full")
        return number

    def write_trajectory(self, positions_rad: Sequence[float]) -> None:
        """Fill the shared area that ReferenceKind.TABLE reads; only while no table motion runs."""
        if len(positions_rad) > TRAJECTORY_SAMPLES:
            raise BadInput("trajectory", f"{len(positions_rad)} samples", f"at most {TRAJECTORY_SAMPLES}")
        self._channel.write_trajectory(positions_rad)

    def drain(self) -> list[bytes]:
        """All cycle records since the last call, raw (servod.formats.recording.record.RECORD)."""
        records = self._channel.drain()
        if records:
            self.latest = CycleRecord.unpack(records[-1])
        return records

    def take_corrupt(self) -> bool:
        """Something that the loop wrote came bent since the last call."""
        return self._channel.take_corrupt()

    def stop(self, timeout_s: float = 1.0) -> int:
        """Ask for a shutdown, wait, and kill what does not end; returns the exit code."""
        assert self._process is not None
        ask_again = time.monotonic()
        deadline = ask_again + timeout_s
        while self.alive() and time.monotonic() <= deadline:
            if time.monotonic() >= ask_again:  # one may come corrupt
                ask_again += _ASK_AGAIN_S
                with contextlib.suppress(Unreachable):  # a loop that takes no commands is killed below
                    self.send(Op.SHUTDOWN)
            self.feed()
            time.sleep(0.005)
        self._process.kill()
        try:
            return self._process.wait(_KILLED_S)
        except subprocess.TimeoutExpired:  # the kernel holds it; it commands nothing any more
            return -signal.SIGKILL

    def close(self) -> None:
        """Give the memory back; nothing else may be called from then on."""
        if self._process and self._process.stderr:
            self._process.stderr.close()
        self._channel.close()

    def last_words(self) -> str:
        """What the process wrote on standard error; call after it ended."""
        stream = self._process.stderr if self._process else None
        return stream.read() if stream and not stream.closed else ""

    def _wait_until_ready(self, meanwhile: Callable[[Callable[[], int | None]], None]) -> None:
        deadline = time.monotonic() + START_TIMEOUT_S
        while self._channel.ready_ns is None:
            if not self.alive():
                words = self.last_words().strip().splitlines()
                if self.exit_code == -signal.SIGALRM:
                    words = ["it was not told its plan in time: is the machine busy with other work?"]
                raise Unreachable(f"the loop process ended at its start: {words[-1] if words else 'no message'}")
            if time.monotonic() > deadline:
                late = f"the loop process did not begin within {START_TIMEOUT_S:.0f} s"
                raise Unreachable(f"{late}: is the machine busy with other work?")
            meanwhile(lambda: self._channel.ready_ns)
            time.sleep(0.01)
