"""What a soak may find wrong, and where it is kept: every kind counted, the first ones told in full."""

from __future__ import annotations

from collections import Counter
from enum import StrEnum
from typing import NamedTuple

_TOLD = 50


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


class Finding(NamedTuple):
    """One of them; `time_s` is axis time since the beginning, None where it is of no one moment."""

    episode: int
    time_s: float | None
    wrong: Wrong
    text: str


class Findings:
    """All findings of a soak: bounded in memory, whatever goes wrong how often."""

    def __init__(self) -> None:
        self.counts: Counter[Wrong] = Counter()
        self.told: list[Finding] = []
        self.episode = 0
        self._began_ns = 0

    def begin(self, time_ns: int) -> None:
        """Axis time at the beginning."""
        self._began_ns = time_ns

    def add(self, wrong: Wrong, time_ns: int | None, text: str, count: int = 1) -> None:
        """Note one, or `count` alike."""
        self.counts[wrong] += count
        if len(self.told) < _TOLD:
            time_s = None if time_ns is None else (time_ns - self._began_ns) / 1e9
            self.told.append(Finding(self.episode, time_s, wrong, text))
