"""Faults of the bus on demand: frames that vanish or are destroyed, participants that fall silent, lag or go bus-off.

Used by the hub for every frame while a fault is armed. `BusFault` is also the message by which a client of the socket
asks for a fault: an error frame, which no CAN controller can send, with this in its data.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

#: operation u8, participant u8, identifier u16, count or milliseconds u32
_MESSAGE = struct.Struct("<BBHI")
#: `can_id` of a fault that hits every frame.
ANY_ID = 0xFFFF
#: `participant` that means the client which sends the request.
MYSELF = 0


class FaultKind(IntEnum):
    """What can go wrong on demand."""

    NONE = 0
    DROP = 1  # the next `amount` frames with `can_id` reach nobody
    CORRUPT = 2  # the next `amount` frames with `can_id` are destroyed and repeated (error counters grow)
    BUS_OFF = 3  # the participant goes bus-off
    SILENT = 4  # the participant neither sends nor hears for `amount` ms (a node without supply, a cut wire)
    DELAY = 5  # the participant sends everything `amount` microseconds later
    ACCEPT = 6  # no fault, a receive filter: the client that asks gets only the identifiers that it named


class BusFault(NamedTuple):
    """One request. `participant`: node id, or MYSELF; only for BUS_OFF, SILENT and DELAY."""

    kind: FaultKind
    can_id: int = ANY_ID
    amount: int = 1
    participant: int = MYSELF

    def encode(self) -> bytes:
        """Eight bytes for an error frame."""
        return _MESSAGE.pack(self.kind, self.participant, self.can_id, self.amount)

    @classmethod
    def decode(cls, data: bytes) -> BusFault:
        """The request in eight bytes; kind NONE when it is not one."""
        kind, participant, can_id, amount = _MESSAGE.unpack(data)
        if kind not in FaultKind.__members__.values():
            return cls(FaultKind.NONE)
        return cls(FaultKind(kind), can_id, amount, participant)


@dataclass(slots=True)
class _Armed:
    kind: FaultKind
    can_id: int
    left: int


class FrameFaults:
    """The armed faults that hit single frames."""

    def __init__(self) -> None:
        self._faults: list[_Armed] = []
        self.armed = False

    def arm(self, kind: FaultKind, can_id: int = ANY_ID, count: int = 1) -> None:
        """Hit the next `count` frames whose identifier is `can_id` (or any)."""
        self._faults.append(_Armed(kind, can_id, count))
        self.armed = True

    def clear(self) -> None:
        """Take all armed faults back."""
        self._faults.clear()
        self.armed = False

    def strike(self, can_id: int) -> FaultKind:
        """What happens to the frame that ends now; uses one count up."""
        for fault in self._faults:
            if fault.can_id in (ANY_ID, can_id & 0x7FF):
                fault.left -= 1
                if fault.left <= 0:
                    self._faults.remove(fault)
                    self.armed = bool(self._faults)
                return fault.kind
        return FaultKind.NONE
