"""An independent witness of SYNC: its own place on the bus, its own count, held against the recorded rows.

Beside the loop, which never sees it: what it hears has been on the bus.
"""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from servod.drivers.virtual.client import VirtualBus
from servod.drivers.virtual.hub import Hub
from servod.drivers.virtual.port import Port
from servod.lab.recordings.recording import Rows
from servod.qualify.soak.tally import Findings, Wrong
from servod.runtime.fieldbus.cia import SYNC_ID

_LISTEN_S = 0.1


class SyncListener:
    """Hears every SYNC of the stepped bus."""

    def __init__(self, hub: Hub) -> None:
        self._times_ns: list[int] = []
        hub.attach(Port("listener", self._heard))

    def take(self) -> list[int]:
        """Moments at which SYNC frames ended on the bus since the last call [ns]."""
        times_ns, self._times_ns = self._times_ns, []
        return times_ns

    def _heard(self, can_id: int, _data: bytes, time_ns: int) -> None:
        if can_id == SYNC_ID:
            self._times_ns.append(time_ns)


class SyncCheck:
    """Every row has its SYNC on the bus within its period, and every SYNC its row.

    `syncs` counts what was heard, `taken` the rows whose SYNC a fault of the schedule took.
    """

    def __init__(self, period_ns: int, findings: Findings) -> None:
        self._period_ns, self._findings = period_ns, findings
        self.syncs = self.taken = 0

    def check(self, rows: Rows, heard_ns: list[int], may_be_taken: bool) -> None:
        """One batch of whole cycles and the SYNCs that were heard meanwhile."""
        self.syncs += len(heard_ns)
        times_ns, heard = rows["time_ns"], np.array(heard_ns, dtype=np.int64)
        # A row before all others takes what belongs to none of them.
        starts = np.concatenate(([-self._period_ns], times_ns))
        row = np.searchsorted(starts, heard, side="right") - 1
        alone = heard - starts[row] >= self._period_ns
        self._report(heard, alone, "SYNC on the bus without a row")
        counts = np.bincount(row[~alone], minlength=len(starts))[1:]
        self._report(times_ns, counts > 1, "row with more than one SYNC")
        if may_be_taken:
            self.taken += int((counts == 0).sum())
        else:
            self._report(times_ns, counts == 0, "row without SYNC on the bus")

    def _report(self, times_ns: NDArray[np.int64], where: NDArray[np.bool_], text: str) -> None:
        if where.any():
            self._findings.add(Wrong.SYNC, int(times_ns[int(np.argmax(where))]), text, int(where.sum()))


class SyncThread:
    """Counts SYNC as a client of the hub's socket, in a thread that does nothing else.

    `count` SYNC frames so far; `overruns` tells how often the hub had to drop frames because this thread got no turn.
    """

    def __init__(self, path: Path) -> None:
        """Raises Unreachable when no hub serves at `path`."""
        self._bus = VirtualBus(str(path), (SYNC_ID,))
        self.count = 0
        self._ends = threading.Event()
        self._thread = threading.Thread(target=self._listen, name="sync listener", daemon=True)
        self._thread.start()

    @property
    def overruns(self) -> int:
        """Error frames by which the hub said so."""
        return self._bus.counters.error_frames

    def close(self) -> None:
        """Leave the bus."""
        self._ends.set()
        self._thread.join()
        self._bus.close()

    def _listen(self) -> None:
        while not self._ends.is_set():
            frame = self._bus.receive(_LISTEN_S)
            if frame is not None and frame.can_id == SYNC_ID:
                self.count += 1
