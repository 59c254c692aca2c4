"""What a soak counts: faults by kind with the times of detection and reaction, motions, codes that were latched.

Bounded: times go into bins of a millisecond, never into lists.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from servod.common.units import NS_PER_S
from servod.qualify.soak.plan import Episode

_BINS_MS = 1000


class Times:
    """Times of one kind, in bins of a millisecond."""

    def __init__(self) -> None:
        self.bins: NDArray[np.int64] = np.zeros(_BINS_MS + 1, dtype=np.int64)
        self.largest_ms = 0.0

    def add(self, time_ms: float) -> None:
        """Count one."""
        self.bins[min(int(time_ms), _BINS_MS)] += 1
        self.largest_ms = max(self.largest_ms, time_ms)

    def document(self) -> dict[str, Any]:
        """Count, median and largest, and the bins that are not empty."""
        bins = {int(bin_ms): int(self.bins[bin_ms]) for bin_ms in np.flatnonzero(self.bins)}
        return {
            "count": sum(bins.values()),
            "median_ms": median_ms(bins),
            "largest_ms": round(self.largest_ms, 3),
            "bins_ms": {str(bin_ms): count for bin_ms, count in bins.items()},
        }


def median_ms(bins: Mapping[int, int]) -> int:
    """The bin in which the middle one of all times stands; 0 when there are none."""
    middle, passed = (sum(bins.values()) + 1) // 2, 0
    for bin_ms in sorted(bins):
        passed += bins[bin_ms]
        if passed >= middle:
            return bin_ms
    return 0


#: What is counted of a kind of fault.
COUNTED = ("injected", "proving", "due", "found", "ridden", "spoilt", "recovered")


@dataclass
class FaultTally:
    """One kind of fault; `proving`: so many came while the wiring was being tested.

    Of those that were injected, `due` must be found in the log, and `found` were. All others left their trace on the
    bus: `ridden` through, or `spoilt` the wiring test, which was then done again.
    """

    injected: int = 0
    proving: int = 0
    due: int = 0
    found: int = 0
    ridden: int = 0
    spoilt: int = 0
    recovered: int = 0
    latched: Counter[str] = field(default_factory=Counter)
    detected: Times = field(default_factory=Times)
    left: Times = field(default_factory=Times)
    gone: Times = field(default_factory=Times)

    def document(self) -> dict[str, Any]:
        """As JSON has it."""
        return {
            **{name: getattr(self, name) for name in COUNTED},
            "latched": dict(self.latched),
            "detected": self.detected.document(),
            "left_command": self.left.document(),
            "torque_gone": self.gone.document(),
        }


class Tally:
    """All counts of one soak."""

    def __init__(self) -> None:
        self.faults: dict[str, FaultTally] = {}
        self.moves: Counter[str] = Counter()
        self.endings: Counter[str] = Counter()
        self.laws: Counter[str] = Counter()
        self.excused: Counter[str] = Counter()  # what only a starved machine explains
        self.episodes = self.restarts = 0

    def of(self, kind: str) -> FaultTally:
        """The tally of one kind of fault."""
        return self.faults.setdefault(kind, FaultTally())


# --- Findings --------------------------------------------------------------------------------------------------------
# What a soak may find wrong, and where it is kept: every kind counted, the first ones told in full.


_MOST_ANOMALIES = 50


class Wrong(StrEnum):
    """Everything that ends a soak with "no"."""

    LOST_ROW = "lost row"
    DOUBLE_ROW = "row recorded twice"
    TIME = "time stamp off its cycle"
    SYNC = "SYNC and rows differ"
    NOT_FINITE = "number that is not finite"
    TORQUE = "torque that nobody commands"
    LIMIT = "torque above its limit"
    STATE = "unexplained state"
    UNEXPLAINED = "fault without a cause in the schedule"
    NOT_FOUND = "fault of the schedule not found in the log"
    NO_TRACE = "fault of the schedule without a trace on the bus"
    LATE = "reaction too late"
    NOT_RECOVERED = "axis not enabled again"
    REFUSED = "motion or command refused"
    RECORDER = "recording differs from the rows"
    MEMORY = "memory grows"
    DESCRIPTORS = "open descriptors grow"


class Anomaly(NamedTuple):
    """One of them; `time_s` is axis time since the beginning, None where it is of no one moment."""

    episode: int
    time_s: float | None
    wrong: Wrong
    text: str


class Findings:
    """All findings of a soak: bounded in memory, whatever goes wrong how often."""

    def __init__(self) -> None:
        self.counts: Counter[Wrong] = Counter()
        self.anomalies: list[Anomaly] = []
        self.episode = 0
        self._began_ns = 0

    def begin(self, time_ns: int) -> None:
        """Axis time at the beginning."""
        self._began_ns = time_ns

    def add(self, wrong: Wrong, time_ns: int | None, text: str, count: int = 1) -> None:
        """Note one, or `count` alike."""
        self.counts[wrong] += count
        if len(self.anomalies) < _MOST_ANOMALIES:
            time_s = None if time_ns is None else (time_ns - self._began_ns) / 1e9
            self.anomalies.append(Anomaly(self.episode, time_s, wrong, text))


# --- Counts ----------------------------------------------------------------------------------------------------------
# What a soak counts on its axis, and what it asks of one, whatever the axis runs on.


class Counts(NamedTuple):
    """Three counters of the same cycles by three witnesses, and what else was checked.

    `cycles`: as the loop numbers them, `rows`: as they were recorded, `missed`: periods that the loop skipped; `syncs`:
    SYNC frames that an independent listener heard, `syncs_taken`: those that a fault of the schedule took. `recordings`
    of the recorder were read back and had all `rows_read_back`.
    """

    period_ns: int
    cycles: int
    rows: int
    missed: int
    syncs: int
    syncs_taken: int
    drive_samples: int
    recordings: int
    rows_read_back: int

    @property
    def axis_s(self) -> float:
        """The time that the axis has run."""
        return self.cycles * self.period_ns / NS_PER_S


class SoakedAxis(Protocol):
    """An axis in a soak."""

    findings: Findings
    tally: Tally

    @property
    def counts(self) -> Counts:
        """What was counted so far."""
        ...

    def processes(self) -> dict[str, int]:
        """Processes whose memory is watched: name and process id."""
        ...

    def episode(self, episode: Episode) -> None:
        """Let one episode happen. Raises AnswerIsNo when the axis cannot be enabled any more, by nothing."""
        ...

    def finish(self) -> None:
        """Check what is left to check. Raises ServodError when the axis does not come to its end."""
        ...

    def close(self) -> None:
        """Leave everything."""
        ...
