"""Faults of the bus on demand: frames that vanish or come otherwise than sent, participants that fall silent or babble.

The hub asks for every frame while one is armed, the world does the rest. `BusFault` is the message by
which a client of the socket asks for a fault: an error frame, which no CAN controller can send, with this in its data.
"""

from __future__ import annotations

import struct
from enum import IntEnum
from typing import NamedTuple

#: operation u8, participant or detail u8, identifier u16, count or milliseconds u32
_MESSAGE = struct.Struct("<BBHI")
#: `can_id` of a fault that hits every frame.
ANY_ID = 0xFFFF
#: Where the subindex stands in the `amount` of a WRITE.
SUBINDEX_SHIFT = 24
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
    LATE = 7  # the next `amount` frames with `can_id` arrive `detail` tenths of a millisecond late
    DUPLICATE = 8  # they arrive twice
    REORDER = 9  # they arrive right after the next frame with the same identifier
    SHORTEN = 10  # their last `detail` bytes are missing
    FLIP = 11  # their bit `detail` is wrong and the check sum did not show it
    STUCK = 12  # the participant's frames wait in its queue for `amount` ms; it goes on hearing
    DOWN = 13  # the participant's interface is down for `amount` ms
    BABBLE = 14  # somebody sends `can_id` for `amount` ms, `detail` frames each ms (0: as many as the bus takes)
    TWIN = 15  # a second node with the participant's id is switched on
    CLEAR = 16  # no frame is hit any more
    WRITE = 18  # the node's object `can_id` gets what `amount` says, past the bus: subindex in its first octet, value
    HAPPENED = 17  # no fault, a question: how often the kind `amount` took effect so far; the answer has it as `amount`


#: Kinds that hit the next frames with an identifier; they do not concern a participant.
FRAME_KINDS = frozenset(
    {
        FaultKind.DROP,
        FaultKind.CORRUPT,
        FaultKind.LATE,
        FaultKind.DUPLICATE,
        FaultKind.REORDER,
        FaultKind.SHORTEN,
        FaultKind.FLIP,
    }
)
_BY_IDENTIFIER = FRAME_KINDS | {FaultKind.BABBLE, FaultKind.CLEAR}


class BusFault(NamedTuple):
    """One request. `participant`: node id, or MYSELF; kinds that concern none have their detail in its place."""

    kind: FaultKind
    can_id: int = ANY_ID
    amount: int = 1
    participant: int = MYSELF

    @property
    def detail(self) -> int:
        """The further number that the kind asks for."""
        return self.participant

    @property
    def concerns(self) -> tuple[FaultKind, int]:
        """What its effect is counted by: the kind, and the identifier or the participant that it hits."""
        return self.kind, self.can_id if self.kind in _BY_IDENTIFIER else self.participant

    @classmethod
    def write(cls, node_id: int, index: int, subindex: int, value: int) -> BusFault:
        """An object of a node changes, as its maker's tool would change it over a plug of its own."""
        return cls(FaultKind.WRITE, index, subindex << SUBINDEX_SHIFT | value, node_id)

    def encode(self) -> bytes:
        """Eight bytes for an error frame."""
        return _MESSAGE.pack(self.kind, self.participant, self.can_id, self.amount)

    @classmethod
    def decode(cls, data: bytes) -> BusFault:
        """The request in eight bytes; kind NONE when it is not one."""
        kind, participant, can_id, amount = _MESSAGE.unpack(data)
        known = kind_of(kind)
        return cls(known, can_id, amount, participant) if known else cls(known)


def kind_of(number: int) -> FaultKind:
    """The kind with this number; NONE when there is none."""
    return FaultKind(number) if number in FaultKind.__members__.values() else FaultKind.NONE
