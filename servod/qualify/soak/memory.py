"""Does the process grow? Resident size and open descriptors over time, in a bounded number of samples.

Beside everything: looks at /proc of one process.
"""

from __future__ import annotations

import ctypes
import gc
import itertools
import math
import os
import time
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

#: More growth than this is a leak: a month of it would still fit a small machine. Hours are those of the axis.
LIMIT_KB_PER_H = 1024.0
#: What the allocator may take and give back without it meaning anything [kB].
_SLACK_KB = 2048.0
_MOST_SAMPLES = 2048
#: The second half becomes so many points, which may count as independent: the least that the process held in each.
_BLOCKS = 12
#: Student's t for 95 %, two-sided, with _BLOCKS - 2 degrees of freedom.
_T95 = 2.228
#: Before so long [s] caches and buffers still fill, and growth is none.
SETTLED_S = 1800.0
#: A process that was watched for so long [s of axis time] must be told. One hour cannot: resident size breathes by
#: single arenas of Python's allocator, of 1 MiB each, which makes its interval +-1.5 MB/h.
LONG_S = 4 * 3600.0
_PAGE_KB = os.sysconf("SC_PAGE_SIZE") / 1024.0


class Growth(StrEnum):
    """What the samples say."""

    FLAT = "flat"
    GROWS = "grows"
    TOO_SHORT = "too short to tell"


@dataclass(frozen=True)
class Slope:
    """Growth of the resident size over the second half, kB/h with its 95 % interval, and what it means."""

    kb_per_h: float
    low_kb_per_h: float
    high_kb_per_h: float
    growth: Growth


class Memory:
    """Samples of one process; when there are too many, every other one is dropped and the interval doubled."""

    def __init__(self, pid: int | None = None, interval_s: float = 5.0) -> None:
        self.pid = os.getpid() if pid is None else pid
        self._folder, self._interval_s = Path("/proc") / str(self.pid), interval_s
        self._samples = np.zeros((_MOST_SAMPLES, 3))
        self._count, self._next_s = 0, -math.inf

    def sample(self, now_s: float | None = None) -> None:
        """Look, when it is time by the wall's clock, or by the one that `now_s` is of."""
        now_s = time.monotonic() if now_s is None else now_s
        if now_s < self._next_s:
            return
        self._next_s = now_s + self._interval_s
        if self.pid == os.getpid():
            _hand_back()
        pages = int((self._folder / "statm").read_text(encoding="utf-8").split()[1])
        self.add(now_s, pages * _PAGE_KB, sum(1 for _ in (self._folder / "fd").iterdir()))

    def add(self, now_s: float, resident_kb: float, descriptors: int) -> None:
        """Take one sample."""
        if self._count == _MOST_SAMPLES:
            self._count //= 2
            self._samples[: self._count] = self._samples[::2]
            self._interval_s *= 2.0
        self._samples[self._count] = now_s, resident_kb, descriptors
        self._count += 1

    @property
    def curve(self) -> NDArray[np.float64]:
        """Rows of time since the first sample [s], resident size [kB], open descriptors."""
        samples = self._samples[: self._count].copy()
        if self._count:
            samples[:, 0] -= samples[0, 0]
        return samples

    def slope(self) -> Slope:
        """Growth over the second half."""
        curve = self.curve
        edges = np.linspace(0.5, 1.0, _BLOCKS + 1) * (curve[-1, 0] if len(curve) else 0.0)
        bounds = np.searchsorted(curve[:, 0], edges)
        if np.diff(bounds).min() < 1:
            return Slope(0.0, -math.inf, math.inf, Growth.TOO_SHORT)
        blocks = [curve[begin:end] for begin, end in itertools.pairwise(bounds)]
        points = np.array([(block[:, 0].mean(), block[:, 1].min()) for block in blocks])
        hours, resident_kb = points[:, 0] / 3600.0, points[:, 1]
        (slope, level), spread = np.polyfit(hours, resident_kb, 1), hours - hours.mean()
        rest = resident_kb - slope * hours - level
        width = _T95 * math.sqrt(float(rest @ rest) / (_BLOCKS - 2) / float(spread @ spread))
        growth = _growth(slope, width, points)
        if growth is Growth.GROWS and self.watched_s < SETTLED_S:
            growth = Growth.TOO_SHORT
        return Slope(float(slope), float(slope - width), float(slope + width), growth)

    @property
    def watched_s(self) -> float:
        """From the first sample to the last."""
        return float(self._samples[self._count - 1, 0] - self._samples[0, 0]) if self._count else 0.0

    def descriptors_grow(self) -> bool:
        """More descriptors are open in the last quarter than ever were in the second one."""
        descriptors, quarter = self._samples[: self._count, 2], self._count // 4
        if quarter < 4:
            return False
        return bool(descriptors[-quarter:].min() > descriptors[quarter : 2 * quarter].max())


def _hand_back() -> None:
    """Let this process give back what it does not use, so that only what it holds is measured (malloc_trim(3))."""
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)


def _growth(slope: float, width: float, points: NDArray[np.float64]) -> Growth:
    if slope + width <= LIMIT_KB_PER_H:
        return Growth.FLAT
    rise_kb = slope * (points[-1, 0] - points[0, 0]) / 3600.0
    return Growth.GROWS if slope - width > LIMIT_KB_PER_H and rise_kb > _SLACK_KB else Growth.TOO_SHORT
