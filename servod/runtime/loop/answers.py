"""Synchronous frames that the nodes owe: one of each kind for each SYNC. One more is somebody else's."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Final

from servod.runtime.fieldbus.bus import Frame

#: A frame that is missing stays owed, since a bus that stalls delivers it later. What stayed owed at every SYNC while
#: so many cycles had all their feedback is lost; frames of one identifier never overtake one another.
_COMPLETE_CYCLES: Final = 50
#: Of lost frames one stays owed: a node that answers by a clock of its own may be a cycle behind all the while, which
#: looks the same, and sends two in one cycle when it catches up.
_STAY_OWED: Final = 1
#: A stall is over when so many SYNCs in a row found no more owed than that: its last frames need a cycle or two.
_IN_TIME: Final = 5


class Answers:
    """Tells a frame that a node owed from one that nobody asked for.

    A controller that did not see its frame acknowledged by all sends it once more, at once, and who had taken it has it
    twice (ISO 11898-1: the last bit of end of frame). So of a frame that came alone since its SYNC one copy may pass;
    not behind a stall, whose last frames at rest look like copies of one another.
    """

    def __init__(self, can_ids: Iterable[int], repeated_ns: int) -> None:
        """Identifiers of the frames that answer a SYNC; a copy that comes within `repeated_ns` is CAN's own."""
        self._owed = dict.fromkeys(can_ids, 0)
        self._least = dict(self._owed)  # of what was owed at each SYNC, since the count of complete cycles began
        self._complete = 0
        self._in_time = dict.fromkeys(self._owed, _IN_TIME)  # SYNCs in a row at which no earlier frame was owed
        self._newest: dict[int, tuple[Frame, int, bool]] = {}  # with its SYNC, and whether a copy of it may pass
        self._repeated_ns, self._sync_ns = repeated_ns, 0

    def __contains__(self, can_id: int) -> bool:
        return can_id in self._owed

    def ask(self, sync_ns: int) -> None:
        """A SYNC went out: each node owes one frame more."""
        owed, least = self._owed, self._least
        self._sync_ns = sync_ns
        for can_id, count in owed.items():
            least[can_id] = min(least[can_id], count)
        if self._complete >= _COMPLETE_CYCLES:
            self._complete = 0
            for can_id in owed:
                owed[can_id] -= max(least[can_id] - _STAY_OWED, 0)
                least[can_id] = owed[can_id]
        for can_id in owed:
            self._in_time[can_id] = 0 if owed[can_id] > _STAY_OWED else self._in_time[can_id] + 1
            owed[can_id] += 1

    def complete(self) -> None:
        """The cycle had all its feedback in time."""
        self._complete += 1

    def take(self, frame: Frame) -> bool:
        """Whether a node may have sent this frame, which is counted off then."""
        can_id, newest = frame.can_id, self._newest.get(frame.can_id)
        if self._owed[can_id] > 0:
            self._owed[can_id] -= 1
            alone = newest is None or newest[1] != self._sync_ns
            self._newest[can_id] = frame, self._sync_ns, alone and self._in_time[can_id] >= _IN_TIME
            return True
        if newest is None:
            return False
        before, sync_ns, alone = newest
        self._newest[can_id] = before, sync_ns, False
        return alone and frame.data == before.data and frame.time_ns - before.time_ns <= self._repeated_ns


class Rare:
    """The same of frames that come with every n-th SYNC: more than half of n lies between two of them.

    Of two frames with a third between them one is nearer, whatever the phase; a node that answers a cycle or two late
    is as far away as ever. A stall delivers what it held in the order in which each node sent it, so the distance is
    counted in the node's frames of each SYNC as well; where those are lost, SYNC counts.
    """

    def __init__(self, syncs: Mapping[int, tuple[int, int]], repeated_ns: int) -> None:
        """Of each identifier its n and that of the same node's frame of each SYNC; within `repeated_ns` CAN copies."""
        self._syncs, self._repeated_ns = dict(syncs), repeated_ns
        self._asked = 0
        self._heard = {beside: 0 for _, beside in syncs.values()}
        self._newest: dict[int, tuple[Frame, int, int, bool]] = {}  # with both counts; whether a copy may pass

    def __contains__(self, can_id: int) -> bool:
        return can_id in self._syncs

    def ask(self) -> None:
        """A SYNC went out."""
        self._asked += 1

    def hear(self, can_id: int) -> None:
        """A frame of each SYNC came."""
        if can_id in self._heard:
            self._heard[can_id] += 1

    def take(self, frame: Frame) -> bool:
        """Whether the node may have sent this frame."""
        count, beside = self._syncs[frame.can_id]
        asked, heard = self._asked, self._heard[beside]
        if (before := self._newest.get(frame.can_id)) is not None:
            newest, asked_then, heard_then, alone = before
            if 2 * max(asked - asked_then, heard - heard_then) <= count:
                self._newest[frame.can_id] = newest, asked_then, heard_then, False
                return alone and frame.data == newest.data and frame.time_ns - newest.time_ns <= self._repeated_ns
        self._newest[frame.can_id] = frame, asked, heard, True
        return True
