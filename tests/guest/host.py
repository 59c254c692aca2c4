"""What the host keeps from the guest: time for which its processes waited, and stand-stills of the whole processor.

The guest cannot see either from inside. Each one is a file in a folder that the guest shares; a scenario that failed
meanwhile is run again there (inside/faults.py).
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.starved import Stalls

#: Looks this often; a look is told when the guest waited for a larger share of it, or stood still for longer: one of
#: its cycles. Alone on a processor its processes wait for one another for some 3 % of the time,
#: for 20 % where many start.
_LOOK_S, _WAITED_SHARE, _STOOD_S = 1.0, 0.3, 0.02


@contextmanager
def told(group: int, folder: Path) -> Iterator[None]:
    """Watch the processes of a group for the time of a `with` block."""
    folder.mkdir(exist_ok=True)
    end, stalls = threading.Event(), Stalls()
    stalls.watch()
    watcher = threading.Thread(target=_watch, args=(group, folder, stalls, end), daemon=True)
    watcher.start()
    try:
        yield
    finally:
        end.set()
        watcher.join()
        stalls.end()


def _watch(group: int, folder: Path, stalls: Stalls, end: threading.Event) -> None:
    last_s, last = time.monotonic(), _waited_s(group)
    while not end.wait(_LOOK_S):
        now_s, now = time.monotonic(), _waited_s(group)
        stood_s = stalls.longest_s(last_s, now_s)
        share = sum(max(0.0, waited - last.get(task, waited)) for task, waited in now.items()) / (now_s - last_s)
        if share > _WAITED_SHARE or stood_s > _STOOD_S:
            (folder / f"{now_s:.1f} s: waited {share:.0%}, stood still for {1e3 * stood_s:.0f} ms").touch()
        last_s, last = now_s, now


def _waited_s(group: int) -> dict[str, float]:
    """For how long each task of the group has waited for a processor so far."""
    waited = {}
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if int((process / "stat").read_text().rpartition(")")[2].split()[2]) == group:
                for task in (process / "task").iterdir():
                    waited[str(task)] = int((task / "schedstat").read_text().split()[1]) / 1e9
        except OSError:  # it has gone meanwhile
            continue
    return waited
