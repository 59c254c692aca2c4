"""The trace that a fault leaves on the bus, by which a soak knows that it happened: no fault word tells what the axis
rides through.

Beside the loop, which never sees it: a listener of its own hears SYNC and the frames that the fault hits. What it hears
is counted from SYNC to SYNC and not by time, so that it tells the same on the wall clock.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from enum import StrEnum
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import NamedTuple

from servod.drivers.virtual.client import VirtualBus
from servod.drivers.virtual.hub import Hub
from servod.drivers.virtual.port import Port
from servod.qualify.faults.actions import InjectionAction
from servod.qualify.faults.actions.base import Who
from servod.qualify.faults.actions.bus import CAN_ID, Babble, FrameFault, FrameName, Frames, Silence
from servod.runtime.fieldbus.cia import SYNC_ID

#: So long before the injection one listens: the rarest frame that is hit, a heartbeat, comes every 50 ms [s].
LISTEN_S = 0.06
#: A frame is missing, or one too many, when its distance from the one before is so many times the usual one.
_FAR, _NEAR = 1.5, 0.5


class Sign(StrEnum):
    """What shows that a fault happened."""

    GAP = "a frame is missing"
    CROWD = "two frames come where one should"
    SHORT = "a frame is shorter than others of its kind"
    HEARD = "a frame comes that nobody else sends"
    DESTROYED = "an error frame"


class BusSign(NamedTuple):
    """A sign, and the frames that bear it."""

    sign: Sign
    can_id: int


class Heard(NamedTuple):
    """One frame on the bus."""

    can_id: int
    data: bytes


_SIGNS = {
    FrameFault.DROP: Sign.GAP,
    FrameFault.DESTROY: Sign.DESTROYED,
    FrameFault.LATE: Sign.CROWD,
    FrameFault.DUPLICATE: Sign.CROWD,
    FrameFault.REORDER: Sign.CROWD,
    FrameFault.SHORTEN: Sign.SHORT,
}
_ANSWERS = {Who.AMPLIFIER: FrameName.DRIVE_FEEDBACK, Who.ENCODER: FrameName.ENCODER_FEEDBACK}


def trace_of(action: InjectionAction) -> BusSign | None:
    """What shows that `action` happened; None where only a fault word does."""
    match action:
        case Frames(of=FrameName.SYNC, fault=FrameFault.DROP):
            return BusSign(Sign.CROWD, CAN_ID[FrameName.TORQUE])  # the loop goes on: two torques from SYNC to SYNC
        case Frames(of=name, fault=fault):
            return BusSign(_SIGNS[fault], CAN_ID[name]) if fault in _SIGNS else None
        case Silence(who=who):
            return BusSign(Sign.GAP, CAN_ID[_ANSWERS[who]]) if who in _ANSWERS else None
        case Babble(can_id=can_id):
            return BusSign(Sign.HEARD, can_id)
    return None


def shows(trace: BusSign, heard: Sequence[Heard], destroyed: int) -> bool:
    """Whether the frames that were `heard` from before the injection on, or the error frames, bear the trace."""
    if trace.sign is Sign.DESTROYED:
        return destroyed > 0
    frames = [frame.data for frame in heard if frame.can_id == trace.can_id]
    if trace.sign is Sign.HEARD:
        return bool(frames)
    if trace.sign is Sign.SHORT:
        return len({len(data) for data in frames}) > 1
    distances = _distances(heard, trace.can_id)
    if not distances:
        return False
    usual = median(distances)
    return max(distances) > _FAR * usual if trace.sign is Sign.GAP else min(distances) < _NEAR * usual


def _distances(heard: Iterable[Heard], can_id: int) -> list[int]:
    """From each frame with `can_id` to the next, in SYNCs between them."""
    sync_counts, syncs = [], 0
    for frame in heard:
        if frame.can_id == SYNC_ID:
            syncs += 1
        elif frame.can_id == can_id:
            sync_counts.append(syncs)
    return [later - earlier for earlier, later in pairwise(sync_counts)]


class Listener(Port):
    """A participant of the stepped bus that listens for one trace, from now on until it is asked."""

    __slots__ = ("_destroyed", "_heard", "_hub", "_trace")

    def __init__(self, hub: Hub, trace: BusSign) -> None:
        super().__init__("trace", self._hear)
        self._hub, self._trace = hub, trace
        self._heard: list[Heard] = []
        self._destroyed = 0
        hub.attach(self)

    def leave(self) -> bool:
        """Leave the bus; whether the trace was there."""
        self._hub.detach(self)
        return shows(self._trace, self._heard, self._destroyed)

    def count(self, transmit: int, receive: int, time_ns: int) -> bool:
        """Whoever sees a frame destroyed counts up."""
        self._destroyed += receive > 0
        return super().count(transmit, receive, time_ns)

    def _hear(self, can_id: int, data: bytes, _time_ns: int) -> None:
        if can_id in (self._trace.can_id, SYNC_ID):
            self._heard.append(Heard(can_id, data))


class BusListener:
    """A client of the hub's socket at `path` that listens for one trace."""

    def __init__(self, path: Path, trace: BusSign) -> None:
        """Raises Unreachable when no hub serves there."""
        self._trace = trace
        self._bus = VirtualBus(str(path), (trace.can_id, SYNC_ID))
        self._heard: list[Heard] = []

    def listen(self, duration_s: float) -> None:
        """Hear what comes in this time; who does not listen loses frames before long."""
        end_s = time.monotonic() + duration_s
        while (left_s := end_s - time.monotonic()) > 0.0:
            frame = self._bus.receive(left_s)
            if frame is not None:
                self._heard.append(Heard(frame.can_id, frame.data))

    def leave(self) -> bool:
        """Leave the bus; whether the trace was there. Of frames that were destroyed a client does not hear."""
        self._bus.close()
        return shows(self._trace, self._heard, 0)
