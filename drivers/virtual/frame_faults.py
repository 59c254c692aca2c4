"""Faults that hit single frames: what becomes of the next frames with an identifier.

Asked by the hub for each frame that ends, while a fault is armed or a frame is held back.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import NamedTuple

from servod.drivers.virtual.bus_faults import ANY_ID, FaultKind

_NS_PER_TENTH_MS = 100_000
#: A frame that comes twice comes again after this time: about what the bus needs for it.
_AGAIN_NS = 150_000


class Strike(NamedTuple):
    """What happens to one frame: its kind of fault, the detail of it, the identifier that the fault was armed for."""

    kind: FaultKind
    detail: int
    armed_for: int = ANY_ID


class Delivery(NamedTuple):
    """Data that reaches the others, and how much later than the end of the frame."""

    data: bytes
    delay_ns: int


@dataclass(slots=True)
class _Armed:
    strike: Strike
    can_id: int
    left: int


UNHURT = Strike(FaultKind.NONE, 0)


class FrameFaults:
    """The armed faults, and the frames that are held back to come out of order.

    `struck` counts, by kind and identifier that the fault was armed for, the frames that came otherwise than sent;
    `cleared` the faults that were taken back.
    """

    def __init__(self) -> None:
        self._faults: list[_Armed] = []
        self._held: dict[int, bytes] = {}
        self.armed = False
        self.struck: Counter[tuple[FaultKind, int]] = Counter()
        self.cleared = 0

    def arm(self, kind: FaultKind, can_id: int = ANY_ID, count: int = 1, detail: int = 0) -> None:
        """Hit the next `count` frames whose identifier is `can_id` (or any)."""
        self._faults.append(_Armed(Strike(kind, detail, can_id), can_id, count))
        self.armed = True

    def clear(self) -> None:
        """Take all armed faults back; what was held back is lost."""
        self.cleared += len(self._faults)
        self._faults.clear()
        self._held.clear()
        self.armed = False

    def strike(self, can_id: int) -> Strike:
        """What happens to the frame that ends now; uses one count up. One that frees a held frame is left alone."""
        if can_id in self._held:
            return UNHURT
        for fault in self._faults:
            if fault.can_id in (ANY_ID, can_id & 0x7FF):
                fault.left -= 1
                if fault.left <= 0:
                    self._faults.remove(fault)
                self._look()
                if fault.strike.kind is FaultKind.CORRUPT:
                    self.struck[FaultKind.CORRUPT, fault.can_id] += 1
                return fault.strike
        return UNHURT

    def deliveries(self, strike: Strike, can_id: int, data: bytes) -> list[Delivery]:
        """What of a frame that was struck reaches the others, and when."""
        found = self._deliveries(strike, can_id, data)
        if strike.kind is not FaultKind.NONE and found != [Delivery(data, 0)]:
            self.struck[strike.kind, strike.armed_for] += 1
        return found

    def _deliveries(self, strike: Strike, can_id: int, data: bytes) -> list[Delivery]:
        kind, detail, _ = strike
        if kind is FaultKind.DROP:
            return []
        if kind is FaultKind.REORDER:
            self._held[can_id] = data
            self._look()
            return []
        if kind is FaultKind.LATE:
            return [Delivery(data, detail * _NS_PER_TENTH_MS)]
        if kind is FaultKind.DUPLICATE:
            return [Delivery(data, 0), Delivery(data, _AGAIN_NS)]
        if kind is FaultKind.SHORTEN:
            return [Delivery(data[: max(0, len(data) - detail)], 0)]
        if kind is FaultKind.FLIP:
            return [Delivery(_flipped(data, detail), 0)]
        held = self._held.pop(can_id, None)
        self._look()
        return [Delivery(data, 0)] if held is None else [Delivery(data, 0), Delivery(held, 0)]

    def _look(self) -> None:
        self.armed = bool(self._faults or self._held)


def _flipped(data: bytes, bit: int) -> bytes:
    """`data` with one bit turned round; bits count from the first byte's lowest."""
    if not data:
        return data
    number = int.from_bytes(data, "little") ^ 1 << bit % (8 * len(data))
    return number.to_bytes(len(data), "little")
