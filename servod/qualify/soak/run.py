"""Runs a soak: episode after episode until the amount, the time or the person says enough; the state goes to disk.

Above the axis (stepped or wall); called by `servoctl soak`.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from servod.common.errors import ServodError
from servod.common.report_files import write_bytes
from servod.qualify.soak.counts import SoakedAxis
from servod.qualify.soak.document import Course, document
from servod.qualify.soak.finding import Wrong
from servod.qualify.soak.memory import Growth, Memory
from servod.qualify.soak.plan import Episode

#: Told one line on how it goes, and the share that is done.
Tell = Callable[[str, float], None]
DOCUMENT_NAME = "soak.json"
_SAVE_S = 10.0


@dataclass
class Watch:
    """The clock on the wall, and the memory of every process that belongs to the soak."""

    limit_s: float
    began_s: float = field(default_factory=time.monotonic)
    memories: dict[str, Memory] = field(default_factory=dict)
    longest: dict[str, Memory] = field(default_factory=dict)

    @property
    def elapsed_s(self) -> float:
        """Time since the beginning."""
        return time.monotonic() - self.began_s

    def look(self, processes: dict[str, int]) -> None:
        """Sample the memory of `processes`; one that was started anew is another one, and the longest lived is kept."""
        for name, pid in processes.items():
            memory = self.memories.get(name)
            if memory is None or memory.pid != pid:
                memory = self.memories[name] = Memory(pid)
            memory.sample()
            if name not in self.longest or memory.watched_s >= self.longest[name].watched_s:
                self.longest[name] = memory


def run(
    axis: SoakedAxis, episodes: Iterable[Episode], cycles: int, limit_s: float, folder: Path, tell: Tell
) -> dict[str, Any]:
    """Soak for `cycles`, at the longest `limit_s`, or through all `episodes`; Ctrl-C ends it early, which is no pass.

    The document is in `folder` all the time.
    """
    watch, course = Watch(limit_s), Course.CUT_SHORT
    try:
        _go_through(axis, episodes, cycles, watch, folder, tell)
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
    axis: SoakedAxis, episodes: Iterable[Episode], cycles: int, watch: Watch, folder: Path, tell: Tell
) -> None:
    next_save_s = 0.0
    watch.look(axis.processes())
    for episode in episodes:
        axis.episode(episode)
        watch.look(axis.processes())
        done, elapsed_s = axis.counts.cycles, watch.elapsed_s
        tell(_line(axis, elapsed_s), max(done / cycles, elapsed_s / watch.limit_s))
        if elapsed_s > next_save_s:
            save(document(axis, watch.longest, elapsed_s, Course.RUNNING), folder)
            next_save_s = elapsed_s + _SAVE_S
        if done >= cycles or elapsed_s >= watch.limit_s:
            return


def _line(axis: SoakedAxis, elapsed_s: float) -> str:
    counts, faults = axis.counts, axis.tally.faults.values()
    speed = counts.cycles * counts.period_ns / 1e9 / max(elapsed_s, 1e-9)
    wrong = sum(axis.findings.counts.values())
    return f"{counts.cycles / 1e6:.2f} M cycles, {speed:.1f}x, {sum(f.injected for f in faults)} faults, {wrong} wrong"


def _judge_memory(axis: SoakedAxis, watch: Watch) -> None:
    for name, memory in watch.longest.items():
        slope = memory.slope()
        if slope.growth is Growth.GROWS:
            axis.findings.add(Wrong.MEMORY, None, f"{name}: {slope.kb_per_h:.0f} kB/h")
        if memory.descriptors_grow():
            axis.findings.add(Wrong.DESCRIPTORS, None, name)
