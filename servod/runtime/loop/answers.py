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


class _Kind:
    """What is known of the frames of one identifier."""

    __slots__ = ("alone", "heard", "in_time", "least", "newest", "newest_sync_ns", "owed")

    def __init__(self) -> None:
        self.owed = self.least = 0  # the least of what was owed at each SYNC since the count of complete cycles began
        self.in_time = _IN_TIME  # SYNCs in a row at which no earlier frame was owed
        self.heard = 0
        self.newest: Frame | None = None
        self.newest_sync_ns = 0
        self.alone = False  # a copy of the newest may pass


class Answers:
    """Tells a frame that a node owed from one that nobody asked for.

    A controller that did not see its frame acknowledged by all sends it once more, at once, and who had taken it has it
    twice (ISO 11898-1: the last bit of end of frame). So of a frame that came alone since its SYNC one copy may pass;
    not behind a stall, whose last frames at rest look like copies of one another.
    """

    def __init__(self, can_ids: Iterable[int], repeated_ns: int) -> None:
        """Identifiers of the frames that answer a SYNC; a copy that comes within `repeated_ns` is CAN's own."""
        self.kinds = {can_id: _Kind() for can_id in can_ids}
        self.asked = 0  # SYNCs
        self._each = tuple(self.kinds.values())
        self._complete = 0
        self._repeated_ns, self._sync_ns = repeated_ns, 0

    def ask(self, sync_ns: int) -> None:
        """A SYNC went out: each node owes one frame more."""
        self._sync_ns = sync_ns
        self.asked += 1
        forgets = self._complete >= _COMPLETE_CYCLES
        if forgets:
            self._complete = 0
        for kind in self._each:
            owed = kind.owed
            kind.least = min(kind.least, owed)
            if forgets:
                owed -= max(kind.least - _STAY_OWED, 0)
                kind.least = owed
            kind.in_time = 0 if owed > _STAY_OWED else kind.in_time + 1
            kind.owed = owed + 1

    def complete(self) -> None:
        """The cycle had all its feedback in time."""
        self._complete += 1

    def take(self, frame: Frame) -> bool:
        """Whether a node may have sent this frame, which is counted off then. KeyError for one of no kind here."""
        kind = self.kinds[frame.can_id]
        kind.heard += 1
        if kind.owed > 0:
            kind.owed -= 1
            alone = kind.newest_sync_ns != self._sync_ns or kind.newest is None
            kind.alone = alone and kind.in_time >= _IN_TIME
            kind.newest, kind.newest_sync_ns = frame, self._sync_ns
            return True
        alone, kind.alone = kind.alone, False
        if kind.newest is None:
            return False
        near = frame.time_ns - kind.newest.time_ns <= self._repeated_ns
        return alone and near and frame.data == kind.newest.data


class Rare:
    """The same of frames that come with every n-th SYNC: more than half of n lies between two of them.

    Of two frames with a third between them one is nearer, whatever the phase; a node that answers a cycle or two late
    is as far away as ever. A stall delivers what it held in the order in which each node sent it, so the distance is
    counted in the node's frames of each SYNC as well; where those are lost, SYNC counts.
    """

    def __init__(self, syncs: Mapping[int, tuple[int, int]], answers: Answers, repeated_ns: int) -> None:
        """Of each identifier its n and that of the same node's frame of each SYNC, which `answers` counts; within
        `repeated_ns` CAN copies."""
        self._syncs, self._answers, self._repeated_ns = dict(syncs), answers, repeated_ns
        self._newest: dict[int, tuple[Frame, int, int, bool]] = {}  # with both counts; whether a copy may pass

    def __contains__(self, can_id: int) -> bool:
        return can_id in self._syncs

    def take(self, frame: Frame) -> bool:
        """Whether the node may have sent this frame."""
        count, beside = self._syncs[frame.can_id]
        asked, heard = self._answers.asked, self._answers.kinds[beside].heard
        if (before := self._newest.get(frame.can_id)) is not None:
            newest, asked_then, heard_then, alone = before
            if 2 * max(asked - asked_then, heard - heard_then) <= count:
                self._newest[frame.can_id] = newest, asked_then, heard_then, False
                return alone and frame.data == newest.data and frame.time_ns - newest.time_ns <= self._repeated_ns
        self._newest[frame.can_id] = frame, asked, heard, True
        return True
