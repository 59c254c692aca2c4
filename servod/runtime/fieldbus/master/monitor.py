"""Watches the nodes of an axis: heartbeats that stop, boot-up where there should be none, EMCY; and who else speaks
with them or for them. Off the control path.

Everything seen becomes a NodeEvent that names a row of the fault table; the supervisor hands it to the loop.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from canopen.emcy import EmcyError

from servod.common.clock import Clock
from servod.common.faults import FaultCode
from servod.common.units import NS_PER_S
from servod.runtime.fieldbus.cia import (
    EMCY_BASE,
    HEARTBEAT_BASE,
    SDO_ANSWER_BASE,
    SDO_REQUEST_BASE,
    Emcy,
    NmtState,
    Obj301,
)
from servod.runtime.fieldbus.master.network import BusNetwork
from servod.runtime.fieldbus.master.sdo import NodeSdo, SdoAnswer

_EMCY = struct.Struct("<HB5s")
_TOGGLE_MASK = 0x7F
_STATES = frozenset(NmtState)
#: States after operational that a node only reaches by NMT.
_LEFT = (NmtState.STOPPED, NmtState.PRE_OPERATIONAL)
#: EMCY of a node that misses its master; what comes before the supervision begins is of the master before us.
MASTER_MISSED = (Emcy.HEARTBEAT_LOST, Emcy.RPDO_TIME_OUT)
#: The guards are read one after the other, so far apart: a few in each second.
_GUARD_NS = 250_000_000
#: A question without an answer is asked again after this time; so many in a row say that it cannot be read.
_UNANSWERED_NS, _MOST_UNANSWERED = 500_000_000, 5
#: More waiting events than this means that nobody reads them; the oldest are dropped then.
_MAX_EVENTS = 1000
#: Who floods the bus with foreign frames is told of once in this time; the fault is latched all the same.
_REPORT_EVERY_NS = NS_PER_S
#: Some nodes take several errors back one by one although the first of these frames says that none is left.
_TAKEN_BACK_NS = NS_PER_S
#: A beat is foreign when it is early beside each of so many before it, and never with less than `_LEAST_NS` to go by.
#: A bus that stalls delivers late, never early: beside the last beat that was in time nothing is early but a stranger.
_BEATS, _LEAST_NS = 16, 200_000_000
#: Beats in a row with the distance of a rhythm make one after this time, which is a stall of the bus that ends.
_RHYTHM_NS = 400_000_000
#: Early is more than this share of the period. A stranger in the first part of a period shows at once, one in the rest
#: by the node's own next beat, which comes right behind. What a clock is slow in `_BEATS` periods adds to the time.
_EARLY = 0.4
#: After a silence of so many periods, and at the begin, what was due may come in a burst, until the rhythm stands.
_SILENCE = 2


@dataclass(frozen=True, slots=True)
class NodeEvent:
    """Something a node did that the axis must know of; `code` is the EMCY code or the NMT state, as the fault says."""

    time_ns: int
    node_id: int
    fault: FaultCode
    text: str
    code: int


class Rhythm:
    """The beats of one sender, each `period_ns` after the one before.

    Tells a second sender of a periodic frame from one sender whose frames come late and then in time again.
    """

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._beats: deque[int] = deque(maxlen=_BEATS)
        self._least, self._rhythm = (max(1, -(-span // period_ns)) for span in (_LEAST_NS, _RHYTHM_NS))
        # Beats that a silence owes; beats in a row with the distance of a rhythm.
        self._owed, self._calm = self._rhythm, 0

    def restart(self, time_ns: int) -> None:
        """The sender begins again at `time_ns`."""
        self._beats.clear()
        self._beats.append(time_ns)
        self._owed, self._calm = self._rhythm, 0

    def foreign(self, time_ns: int) -> bool:
        """Take a beat; True when it cannot be the one sender's."""
        beats, period_ns = self._beats, self._period_ns
        silent = (time_ns - beats[-1]) // period_ns if beats else 0
        by_ns = [period_ns * back - (time_ns - beat) for back, beat in enumerate(reversed(beats), start=1)]
        beats.append(time_ns)
        if silent >= _SILENCE:
            self._owed, self._calm = max(self._owed, silent), 0
        least_ns = _EARLY * period_ns
        if len(by_ns) < self._least or min(by_ns) <= least_ns:
            self._calm += bool(by_ns) and by_ns[0] <= least_ns  # one of a burst says nothing of the rhythm
            self._owed = 0 if self._calm >= self._rhythm else self._owed
            return False
        self._owed, self._calm = self._owed - 1, 0
        return self._owed < 0


class NodeWatch:
    """Heartbeat consumer and EMCY consumer for one node, and its witness against strangers."""

    def __init__(
        self, network: BusNetwork, node_id: int, emcy_fault: FaultCode, period_ms: int, timeout_ms: int
    ) -> None:
        self.node_id = node_id
        self.nmt_state: int | None = None  # not heard yet
        self.boot_ups = 0
        self.events: deque[NodeEvent] = deque(maxlen=_MAX_EVENTS)
        self._clock = network.clock
        self._emcy_fault = emcy_fault
        self._timeout_ns = timeout_ms * 1_000_000
        self._heard_ns: int | None = None  # the watch began, or a heartbeat came
        self._heartbeat_ns: int | None = None
        self.lost = False  # its heartbeat is missing now
        self._watching = False
        self._rhythm = Rhythm(period_ms * 1_000_000)
        self._errors = 0  # that the node told of, or had at the bring-up, and may take back
        self._in_register = True  # the last that it told of
        self._none_left_ns = 0  # since when it says that it has none, 0 while it does not
        self._answers = network.answers
        self._reported_ns: dict[FaultCode, int] = {}
        #: Who else spoke with the node while it was set up, the first of them; `sets_up`: our own transfers write.
        self.foreign, self.sets_up = "", False
        network.subscribe(HEARTBEAT_BASE + node_id, self._on_heartbeat)
        network.subscribe(EMCY_BASE + node_id, self._on_emcy)
        network.subscribe(SDO_REQUEST_BASE + node_id, self._on_request)
        network.subscribe(SDO_ANSWER_BASE + node_id, self._on_answer)

    @property
    def watching(self) -> bool:
        """Whether the supervision is on."""
        return self._watching

    def watch(self, on: bool) -> None:
        """Start or end the supervision: only then a boot-up, a stop of heartbeats or another state is an event.

        What the drive told before the begin, of a master that died, is no event of ours.
        """
        if on:  # the end may come in another thread than the events
            for event in [event for event in self.events if event.code in MASTER_MISSED]:
                self.events.remove(event)
        self._heard_ns, self.lost, self._watching = self._clock.now_ns(), False, on

    @property
    def at_work(self) -> bool:
        """Supervised, heard and operational: one that was reset has lost its settings too, which is no fault more."""
        return self._watching and not self.lost and self.nmt_state == NmtState.OPERATIONAL

    @property
    def limit_s(self) -> float:
        """A heartbeat older than this is missing."""
        return self._timeout_ns / NS_PER_S

    def heartbeat_age_s(self) -> float | None:
        """How long ago the last heartbeat came, in s; None before the first."""
        return None if self._heartbeat_ns is None else (self._clock.now_ns() - self._heartbeat_ns) / NS_PER_S

    def check(self) -> None:
        """Raise an event when the heartbeat has been missing for its time; once for each loss."""
        if not self._watching or self.lost or self._heard_ns is None:
            return
        silent_ns = self._clock.now_ns() - self._heard_ns
        if silent_ns > self._timeout_ns:
            self.lost = True
            text = f"node {self.node_id}: no heartbeat for {silent_ns / 1e6:.0f} ms"
            self.add(FaultCode.NODE_HEARTBEAT_LOST, text, 0)

    @property
    def reports_errors(self) -> bool:
        """By what was heard it has errors that it has not taken back, and they show in its error register."""
        return self._errors > 0 and self._in_register

    def register(self, value: int) -> None:
        """Its error register (0x1001), as it answers now: who has no errors has none to take back either, but for the
        EMCY that may still be on its way."""
        now_ns = self._clock.now_ns()
        self._none_left_ns = 0 if value else self._none_left_ns or now_ns
        if not value and now_ns - self._none_left_ns > _TAKEN_BACK_NS:
            self._errors = 0

    def has_errors(self) -> None:
        """The error register (0x1001) shows errors that the node told of before anybody listened."""
        self._errors, self._none_left_ns, self._in_register = max(self._errors, 1), 0, True

    def _on_heartbeat(self, _can_id: int, data: bytearray, time_ns: float) -> None:
        if len(data) != 1:
            self._misshapen("heartbeat", data, 1)
            return
        state = data[0] & _TOGGLE_MASK
        previous, self.nmt_state = self.nmt_state, state
        self._heard_ns = self._heartbeat_ns = self._clock.now_ns()
        self.lost = False
        if state == NmtState.BOOT_UP:
            self.boot_ups += 1
        foreign = False
        if state != previous:  # told at once, and the rhythm may begin again with it
            self._rhythm.restart(int(time_ns))
        else:
            foreign = self._rhythm.foreign(int(time_ns))
        if not self._watching:
            return
        if state not in _STATES:
            text = f"node {self.node_id}: heartbeat with NMT state {state}, which CiA 301 does not know"
            self._blame(FaultCode.DUPLICATE_NODE, text, state)
        elif foreign:
            self._blame(FaultCode.DUPLICATE_NODE, f"node {self.node_id}: heartbeats of two senders", state)
        if state == NmtState.BOOT_UP:
            self.add(FaultCode.DRIVE_RESET, f"node {self.node_id}: boot-up while it should be operational", state)
        elif state in _LEFT and previous == NmtState.OPERATIONAL:
            text = f"node {self.node_id}: left NMT operational (state {state})"
            self.add(FaultCode.NODE_LEFT_OPERATIONAL, text, state)

    def _on_emcy(self, _can_id: int, data: bytearray, time_ns: float) -> None:
        if not data:
            self._boots_as_of_old()
            return
        if len(data) != _EMCY.size:
            self._misshapen("EMCY", data, _EMCY.size)
            return
        code, register, maker = _EMCY.unpack_from(data)
        if code & 0xFF00 == 0:
            self._take_back(register)
            return
        self._errors, self._none_left_ns, self._in_register = self._errors + 1, 0, register != 0
        meaning = EmcyError(code, register, maker, time_ns).get_desc()
        text = f"node {self.node_id}: EMCY 0x{code:04X} {meaning}, register 0x{register:02X}, {maker.hex(' ')}"
        self.add(self._emcy_fault, text, code)

    def _boots_as_of_old(self) -> None:
        """The boot-up of devices by DS-301 before its version 4: the identifier of an EMCY without data."""
        self.boot_ups += 1
        if self._watching:
            text = f"node {self.node_id}: boot-up as by DS-301 V3 (EMCY without data) while it should be operational"
            self.add(FaultCode.DRIVE_RESET, text, int(NmtState.BOOT_UP))

    def _take_back(self, register: int) -> None:
        """EMCY without a code: an error is gone, or all that were; who had none has nothing to take back."""
        now_ns = self._clock.now_ns()
        if self._none_left_ns and now_ns - self._none_left_ns > _TAKEN_BACK_NS:
            self._errors = 0
        if self._errors == 0:
            text = f"node {self.node_id}: EMCY takes back an error that was never heard (register 0x{register:02X}): "
            text += "somebody else sent it, or the error was lost on the bus"
            self._blame(FaultCode.DUPLICATE_NODE, text, 0)
            return
        self._errors = max(self._errors - 1, 1 if register else 0)
        self._none_left_ns = 0 if register else self._none_left_ns or now_ns

    def _on_request(self, can_id: int, data: bytearray, _time_ns: float) -> None:
        if not self._answers.own(can_id, bytes(data)):
            text = f"node {self.node_id}: SDO request of somebody else, {data.hex(' ')}"
            self.foreign = self.foreign or text
            self._blame(FaultCode.FOREIGN_SDO, text, 0)

    def _on_answer(self, can_id: int, data: bytearray, _time_ns: float) -> None:
        if not self._answers.answered(can_id):
            text = f"node {self.node_id}: SDO answer that this master did not ask for, {data.hex(' ')}"
            if self.sets_up:  # before, it may be for a master that has just ended
                self.foreign = self.foreign or text
            self._blame(FaultCode.FOREIGN_SDO, text, 0)

    def _misshapen(self, what: str, data: bytearray, size: int) -> None:
        """CiA 301 gives the frame one length; it says nothing that could be believed, and no node sends it."""
        text = f"node {self.node_id}: {what} of {len(data)} bytes instead of {size} ({data.hex(' ')})"
        self._blame(FaultCode.DUPLICATE_NODE, text, 0)

    def _blame(self, fault: FaultCode, text: str, code: int) -> None:
        """Somebody else was heard."""
        now_ns = self._clock.now_ns()
        if self._watching and now_ns - self._reported_ns.get(fault, -_REPORT_EVERY_NS) >= _REPORT_EVERY_NS:
            self._reported_ns[fault] = now_ns
            self.add(fault, text, code)

    def add(self, fault: FaultCode, text: str, code: int) -> None:
        """An event of this node."""
        self.events.append(NodeEvent(self._clock.now_ns(), self.node_id, fault, text, code))


#: Whether the node has an error: nothing is expected of it.
_REGISTER = (int(Obj301.ERROR_REGISTER), 0, 0)


class GuardWatch:
    """Reads the guards of a drive again in turn while it runs: anybody on the bus may write them by SDO.

    And whether a node that told of errors still has any: somebody else may have told. Never waits: a question goes out
    in one look, its answer is taken in another.
    """

    def __init__(self, sdo: NodeSdo, watch: NodeWatch, guards: Sequence[tuple[int, int, int]], clock: Clock) -> None:
        self._sdo, self._watch, self._clock = sdo, watch, clock
        self._guards = [(index, subindex, value) for index, subindex, value in guards]
        self._next = self._unanswered = 0
        self._asked: tuple[int, int, int] | None = None
        self._asked_ns, self._register_next = 0, True
        self._reported: set[tuple[int, int]] = set()

    def check(self) -> None:
        """One look; call as often as the node's watch is checked."""
        now_ns = self._clock.now_ns()
        if not self._watch.at_work or not (self._guards or self._watch.reports_errors):
            self._asked = None
        elif self._asked is not None and (answer := self._sdo.answer()) is not None:
            self._judge(self._asked, answer)
            self._asked, self._unanswered = None, 0
        elif self._asked is not None and now_ns - self._asked_ns > _UNANSWERED_NS:
            self._unanswered += self._asked is not _REGISTER
            self._asked = None
            if self._unanswered == _MOST_UNANSWERED:
                self._report((0, 0), "the guards of the drive cannot be read any more")
        elif self._asked is None and now_ns - self._asked_ns >= _GUARD_NS:
            register = self._watch.reports_errors and (self._register_next or not self._guards)
            question = _REGISTER if register else self._guards[self._next]
            if self._sdo.ask(question[0], question[1]):
                self._asked, self._asked_ns, self._register_next = question, now_ns, not register
                self._next = self._next if register else (self._next + 1) % len(self._guards)

    def _judge(self, guard: tuple[int, int, int], answer: SdoAnswer) -> None:
        if guard is _REGISTER:
            if answer.value is not None:
                self._watch.register(answer.value)
            return
        index, subindex, value = guard
        if answer.value == value:
            self._reported.discard((index, subindex))
            return
        found = f"aborts with 0x{answer.abort:08X}" if answer.value is None else f"reads {answer.value}"
        self._report((index, subindex), f"0x{index:04X}:{subindex} was {value}, now {found}")

    def _report(self, guard: tuple[int, int], text: str) -> None:
        """Once, until it is right again."""
        if guard not in self._reported:
            self._reported.add(guard)
            self._watch.add(FaultCode.GUARD_CHANGED, f"node {self._watch.node_id}: {text}", 0)
