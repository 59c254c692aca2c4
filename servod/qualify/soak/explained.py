"""Which faults may be seen when: what the schedule injected, and what a starved machine excuses, each for its time.

Between the schedule and the rows, which are read back later than they were written.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

_OPEN_NS = 2**62


class _Span(NamedTuple):
    begin_ns: int
    end_ns: int
    bits: int


class Explained:
    """Spans of time with the fault bits that may be seen in them; `always`: those that may be seen at any time."""

    def __init__(self, always: int = 0) -> None:
        self._always = always
        self._spans: list[_Span] = []

    def add(self, begin_ns: int, bits: int, end_ns: int = _OPEN_NS) -> None:
        """From `begin_ns` on, faults of `bits` have a cause."""
        self._spans.append(_Span(begin_ns, end_ns, bits))

    def end(self, end_ns: int) -> None:
        """What has had no end yet ends now."""
        self._spans = [span._replace(end_ns=min(span.end_ns, end_ns)) for span in self._spans]

    def at(self, times_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """The bits that may be seen at each of these times."""
        bits = np.full(len(times_ns), self._always, dtype=np.int64)
        for span in self._spans:
            bits[(times_ns >= span.begin_ns) & (times_ns <= span.end_ns)] |= span.bits
        return bits

    def forget(self, before_ns: int) -> None:
        """Every row before this time was checked."""
        self._spans = [span for span in self._spans if span.end_ns >= before_ns]
