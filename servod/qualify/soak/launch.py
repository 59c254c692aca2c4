"""Starts what `servoctl qualify soak` was asked for: one axis in this process, or several in processes of their own."""

from __future__ import annotations

import json
import math
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from servod.client.processes import sigterm_as_interrupt, socket_folder
from servod.common.errors import ServodError, Unreachable
from servod.common.files import reason, write_bytes
from servod.common.progress import OnProgress
from servod.qualify.soak.document import Course, added, document, write_page
from servod.qualify.soak.kinds import KINDS
from servod.qualify.soak.memory import Growth, Memory
from servod.qualify.soak.plan import Episode, schedule
from servod.qualify.soak.stepped import GAIN_SETS, SteppedSoak
from servod.qualify.soak.tally import SoakedAxis, Wrong
from servod.qualify.soak.wall_clock import WallSoak, of_the_wall

# --- The run ---------------------------------------------------------------------------------------------------------
# Runs a soak: episode after episode until the amount, the time or the person says enough; the state goes to disk.


DOCUMENT_NAME = "soak.json"
_SAVE_S = 10.0
#: Between two looks at memory [s of axis time]; a look hands back what is not used, which takes a tenth of a second.
_LOOK_S = 30.0


@dataclass
class SoakWatch:
    """The clock on the wall, and the memory of every process that belongs to the soak."""

    limit_s: float
    began_s: float = field(default_factory=time.monotonic)
    memories: dict[str, Memory] = field(default_factory=dict)
    longest: dict[str, Memory] = field(default_factory=dict)

    @property
    def elapsed_s(self) -> float:
        """Time since the beginning."""
        return time.monotonic() - self.began_s

    def look(self, processes: dict[str, int], axis_s: float) -> None:
        """Sample the memory of `processes` at `axis_s`, the time that the axis has run: what grows grows with cycles,
        moves and faults, and stepped time runs faster than the wall's.

        One that was started again is another one, and the longest lived is kept.
        """
        for name, pid in processes.items():
            memory = self.memories.get(name)
            if memory is None or memory.pid != pid:
                memory = self.memories[name] = Memory(pid, _LOOK_S)
            memory.sample(axis_s)
            if name not in self.longest or memory.watched_s >= self.longest[name].watched_s:
                self.longest[name] = memory


def run(
    axis: SoakedAxis, episodes: Iterable[Episode], cycles: int, limit_s: float, folder: Path, on_progress: OnProgress
) -> dict[str, Any]:
    """Soak for `cycles`, at the longest `limit_s`, or through all `episodes`; Ctrl-C ends it early, which is no pass.

    The document is in `folder` all the time.
    """
    watch, course = SoakWatch(limit_s), Course.CUT_SHORT
    try:
        _go_through(axis, episodes, cycles, watch, folder, on_progress)
        course = Course.COMPLETE
    except KeyboardInterrupt:
        course = Course.INTERRUPTED
    except ServodError as error:
        axis.findings.add(Wrong.NOT_RECOVERED, None, str(error))
    try:
        axis.finish()
    except ServodError as error:
        axis.findings.add(Wrong.STATE, None, f"at the end: {error}")
    _judge_memory(axis, watch)
    found = document(axis, watch.longest, watch.elapsed_s, course)
    save(found, folder)
    return found


def save(found: dict[str, Any], folder: Path) -> None:
    """Write the document, aside and whole."""
    write_bytes(folder / DOCUMENT_NAME, json.dumps(found, indent=2, allow_nan=False).encode())


def _go_through(
    axis: SoakedAxis, episodes: Iterable[Episode], cycles: int, watch: SoakWatch, folder: Path, on_progress: OnProgress
) -> None:
    next_save_s = 0.0
    watch.look(axis.processes(), axis.counts.axis_s)
    for episode in episodes:
        axis.episode(episode)
        watch.look(axis.processes(), axis.counts.axis_s)
        done, elapsed_s = axis.counts.cycles, watch.elapsed_s
        on_progress(_line(axis, elapsed_s), max(done / cycles, elapsed_s / watch.limit_s))
        if elapsed_s > next_save_s:
            save(document(axis, watch.longest, elapsed_s, Course.RUNNING), folder)
            next_save_s = elapsed_s + _SAVE_S
        if done >= cycles or elapsed_s >= watch.limit_s:
            return


def _line(axis: SoakedAxis, elapsed_s: float) -> str:
    counts, faults = axis.counts, axis.tally.faults.values()
    speed = counts.axis_s / max(elapsed_s, 1e-9)
    wrong = sum(axis.findings.counts.values())
    return f"{counts.cycles / 1e6:.2f} M cycles, {speed:.1f}x, {sum(f.injected for f in faults)} faults, {wrong} wrong"


def _judge_memory(axis: SoakedAxis, watch: SoakWatch) -> None:
    for name, memory in watch.longest.items():
        slope = memory.slope()
        if slope.growth is Growth.GROWS:
            axis.findings.add(Wrong.MEMORY, None, f"{name}: {slope.kb_per_h:.0f} kB in an hour of axis time")
        if memory.descriptors_grow():
            axis.findings.add(Wrong.DESCRIPTORS, None, name)


_POLL_S, _CYCLES_PER_S = 1.0, 1000.0
#: After Ctrl-C a job ends its episode's check and writes its document.
_PATIENCE_S = 60.0


class Order(NamedTuple):
    """What was asked for. `limit_hours`: wall clock, None for as long as it takes."""

    cycles: int
    seed: int
    wall: bool
    limit_hours: float | None
    out: Path


def launch(order: Order, jobs: int, on_progress: OnProgress) -> dict[str, Any]:
    """Soak, and write document and page to `order.out`."""
    with sigterm_as_interrupt():
        found = _single(order, on_progress) if jobs == 1 else _several(order, jobs, on_progress)
        found |= {"mode": "wall" if order.wall else "stepped", "seeds": list(range(order.seed, order.seed + jobs))}
    save(found, order.out)
    write_page(found, order.out)
    return found


def _single(order: Order, on_progress: OnProgress) -> dict[str, Any]:
    limit_s = math.inf if order.limit_hours is None else order.limit_hours * 3600.0
    if order.wall:
        return _wall(order, limit_s, on_progress)
    with closing(SteppedSoak(order.seed, order.out)) as axis:
        return run(axis, schedule(order.seed, GAIN_SETS), order.cycles, limit_s, order.out, on_progress)


def _wall(order: Order, limit_s: float, on_progress: OnProgress) -> dict[str, Any]:
    """Cycles take their time on the wall clock; sockets want a short path."""
    kinds = tuple(filter(of_the_wall, KINDS))
    limit_s = min(limit_s, order.cycles / _CYCLES_PER_S)
    with socket_folder("servod-soak-") as folder, closing(WallSoak(order.seed, Path(folder))) as axis:
        return run(axis, schedule(order.seed, GAIN_SETS, kinds), sys.maxsize, limit_s, order.out, on_progress)


def _several(order: Order, jobs: int, on_progress: OnProgress) -> dict[str, Any]:
    """The same command in processes of their own, with seeds of their own; Ctrl-C is passed on."""
    folders = [order.out / str(order.seed + job) for job in range(jobs)]
    processes = [_start(order._replace(seed=order.seed + job, out=folder)) for job, folder in enumerate(folders)]
    try:
        while any(process.poll() is None for process in processes):
            time.sleep(_POLL_S)
            _report_progress(folders, order.cycles, on_progress)
    except KeyboardInterrupt:
        for process in processes:
            process.send_signal(signal.SIGTERM)
    exit_codes = [_ended(process) for process in processes]
    return added([_read(folder) for folder in folders], exit_codes)


def _ended(process: subprocess.Popen[bytes]) -> int:
    """The exit code of a job; one that does not come to its end is killed."""
    try:
        return process.wait(_PATIENCE_S)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()


def _start(order: Order) -> subprocess.Popen[bytes]:
    (order.out / DOCUMENT_NAME).unlink(missing_ok=True)
    command = [
        "qualify",
        "soak",
        "--json",
        "--cycles",
        str(order.cycles),
        "--seed",
        str(order.seed),
        "--out",
        str(order.out),
    ]
    if order.limit_hours is not None:
        command += ["--limit-hours", str(order.limit_hours)]
    return subprocess.Popen(
        [sys.executable, "-m", "servod.cli", *command],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        start_new_session=True,
    )


def _report_progress(folders: Sequence[Path], cycles: int, on_progress: OnProgress) -> None:
    with suppress(Unreachable):
        found = added([_read(folder) for folder in folders])
        share = found["cycles"] / cycles / len(folders)
        on_progress(f"{found['cycles'] / 1e6:.2f} M cycles, {sum(found['wrong'].values())} wrong", share)


def _read(folder: Path) -> dict[str, Any]:
    """The document of a job. Raises Unreachable when it has not written one."""
    try:
        found: dict[str, Any] = json.loads((folder / DOCUMENT_NAME).read_text(encoding="utf-8"))
    except OSError as error:
        raise Unreachable(f"{folder}: the job left no {DOCUMENT_NAME} ({reason(error)})") from None
    return found
