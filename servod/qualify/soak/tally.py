"""What a soak counts: faults by kind with the times of detection and reaction, motions, codes that were latched.

Bounded: times go into bins of a millisecond, never into lists.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
        bins = {int(place): int(self.bins[place]) for place in np.flatnonzero(self.bins)}
        return {
            "count": sum(bins.values()),
            "median_ms": median_ms(bins),
            "largest_ms": round(self.largest_ms, 3),
            "bins_ms": {str(place): count for place, count in bins.items()},
        }


def median_ms(bins: Mapping[int, int]) -> int:
    """The bin in which the middle one of all times stands; 0 when there are none."""
    middle, passed = (sum(bins.values()) + 1) // 2, 0
    for place in sorted(bins):
        passed += bins[place]
        if passed >= middle:
            return place
    return 0


#: What is counted of a kind of fault.
COUNTED = ("injected", "proving", "due", "found", "ridden", "spoilt", "recovered")


@dataclass
class FaultTally:
    """One kind of fault; `proving`: so many came while the wiring was being proven.

    Of those that were injected, `due` must be found in the log, and `found` were. All others left their trace on the
    bus: `ridden` through, or `spoilt` the proof of the wiring, which was then done again.
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
