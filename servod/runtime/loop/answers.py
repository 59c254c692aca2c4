"""Synchronous frames that the nodes owe: one of each kind for each SYNC. One more is somebody else's."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from servod.runtime.fieldbus.bus import Frame

#: A frame that is missing stays owed, since a bus that stalls delivers it later. What stayed owed at every SYNC while
#: so many cycles had all their feedback is lost; frames of one identifier never overtake one another.
_COMPLETE_CYCLES: Final = 50
#: Of lost frames one stays owed: a node that answers by a clock of its own may be a cycle behind all the while, which
#: looks the same, and sends two in one cycle when it catches up.
_STAY_OWED: Final = 1


class Answers:
    """Tells a frame that a node owed from one that nobody asked for.

    A controller that did not see its frame acknowledged by all sends it once more, at once, and who had taken it has it
    twice (ISO 11898-1: the last bit of end of frame). So of a frame that came alone since its SYNC one copy may pass.
    """

    def __init__(self, can_ids: Iterable[int], repeated_ns: int) -> None:
        """Identifiers of the frames that answer a SYNC; a copy that comes within `repeated_ns` is CAN's own."""
        self._owed = dict.fromkeys(can_ids, 0)
        self._least = dict(self._owed)  # of what was owed at each SYNC, since the count of complete cycles began
        self._complete = 0
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
            owed[can_id] += 1

    def complete(self) -> None:
        """The cycle had all its feedback in time."""
        self._complete += 1

    def take(self, frame: Frame) -> bool:
        """Whether a node may have sent this frame, which is counted off then."""
        can_id, newest = frame.can_id, self._newest.get(frame.can_id)
        if self._owed[can_id] > 0:
            self._owed[can_id] -= 1
            self._newest[can_id] = frame, self._sync_ns, newest is None or newest[1] != self._sync_ns
            return True
        if newest is None:
            return False
        before, sync_ns, alone = newest
        self._newest[can_id] = before, sync_ns, False
        return alone and frame.data == before.data and frame.time_ns - before.time_ns <= self._repeated_ns
