"""Frames from fuzz bytes, and buses that speak them."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence

from servod.common.units import NS_PER_S
from servod.runtime.fieldbus.bus import Bus, BusCounters, Frame

#: A bus that never falls silent is no bus: the scripts end, or are cut here.
MOST_FRAMES = 2000


def frames(data: bytes, ids: Sequence[int]) -> Iterator[tuple[int, bytes]]:
    """(identifier, data): an octet chooses the identifier, the next has the length, then the data; all of `data`."""
    at = 0
    while at + 2 <= len(data):
        length = data[at + 1] % 9
        yield ids[data[at] % len(ids)], data[at + 2 : at + 2 + length]
        at += 2 + length


class ScriptClock:
    """Time that passes only where somebody waits."""

    def __init__(self) -> None:
        self.time_ns = NS_PER_S

    def now_ns(self) -> int:
        return self.time_ns

    def sleep_until(self, deadline_ns: int) -> None:
        self.time_ns = max(self.time_ns, deadline_ns)


class ScriptBus:
    """A servod.runtime.fieldbus.bus.Bus on which whatever is asked is answered with the next frames of a script.

    `burst` frames come for each frame that is sent; with none sent, none come.
    """

    def __init__(self, clock: ScriptClock, script: Iterator[tuple[int, bytes]], burst: int = 1) -> None:
        self.counters = BusCounters()
        self._clock, self._script, self._burst = clock, script, burst
        self._waiting: deque[tuple[int, bytes]] = deque()

    def send(self, can_id: int, data: bytes) -> bool:
        self.counters.sent += 1
        for _ in range(self._burst):
            frame = next(self._script, None)
            if frame is not None:
                self._waiting.append(frame)
        return self.counters.sent < MOST_FRAMES

    def receive(self, timeout_s: float = 0.0) -> Frame | None:
        if not self._waiting:
            self._clock.time_ns += max(int(timeout_s * NS_PER_S), 0)
            return None
        self._clock.time_ns += 100_000
        return Frame(*self._waiting.popleft(), self._clock.time_ns)

    def fileno(self) -> int:
        return -1

    def close(self) -> None:
        self.counters.set_down()


class BentBus:
    """Another bus, some of whose frames are lost, doubled, cut, overwritten, or joined by foreign ones.

    Each received frame takes an octet of `script`, which says what happens to it; with the script at its end all frames
    come as they are.
    """

    def __init__(self, bus: Bus, script: bytes, ids: Sequence[int]) -> None:
        self.counters = bus.counters
        self._bus, self._ids = bus, ids
        self._script = iter(script)
        self._waiting: deque[Frame] = deque()

    def send(self, can_id: int, data: bytes) -> bool:
        return self._bus.send(can_id, data)

    def receive(self, timeout_s: float = 0.0) -> Frame | None:
        while True:
            if self._waiting:
                return self._waiting.popleft()
            frame = self._bus.receive(timeout_s)
            if frame is None:
                return None
            self._bend(frame)

    def _bend(self, frame: Frame) -> None:
        what = next(self._script, 0)
        count = what >> 4
        if what & 0xF == 1:  # lost
            return
        if what & 0xF == 2:
            frame = frame._replace(data=frame.data[: count % 9])
        elif what & 0xF == 3:
            frame = frame._replace(data=bytes(next(self._script, 0) for _ in frame.data))
        elif what & 0xF == 4:
            data = bytearray(frame.data)
            for _ in range(1 + count % 3):
                if data:
                    data[next(self._script, 0) % len(data)] ^= next(self._script, 0)
            frame = frame._replace(data=bytes(data))
        elif what & 0xF == 5:
            self._waiting += [frame] * (count + 1)
        elif what & 0xF == 6:
            can_id = self._ids[next(self._script, 0) % len(self._ids)]
            data = bytes(next(self._script, 0) for _ in range(count % 9))
            self._waiting.append(Frame(can_id, data, frame.time_ns))
        self._waiting.append(frame)

    def fileno(self) -> int:
        return -1

    def close(self) -> None:
        self._bus.close()
