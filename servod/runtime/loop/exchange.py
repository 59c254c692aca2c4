"""Frames of one cycle: SYNC out, feedback in, torque and heartbeat out. Only this file knows the bus."""

from __future__ import annotations

from collections.abc import Sequence

from servod.common.clock import Clock
from servod.common.faults import FAULTS, FaultCode
from servod.common.units import NS_PER_S
from servod.runtime.fieldbus.bus import Bus, Frame
from servod.runtime.fieldbus.cia import (
    HEARTBEAT_BASE,
    NMT_ID,
    SYNC_ID,
    TPDO_BASE,
    NmtCommand,
    NmtState,
    ids_of_masters,
)
from servod.runtime.fieldbus.devices import Amplifier, Encoder, PdoMap
from servod.runtime.loop.answers import Answers, Rare
from servod.runtime.loop.plan import LoopPlan

_BUS_OFF, _BUS_DOWN, _QUEUE_FULL = (
    FAULTS[c].bit for c in (FaultCode.BUS_OFF, FaultCode.BUS_DOWN, FaultCode.BUS_QUEUE_FULL)
)
_SECOND_MASTER, _FOREIGN_FEEDBACK = (FAULTS[c].bit for c in (FaultCode.SECOND_MASTER, FaultCode.FOREIGN_FEEDBACK))
_OPERATIONAL = bytes([NmtState.OPERATIONAL])
#: A cycle takes at most this many frames from the socket, so that a babbling node cannot hold the loop.
MAX_FRAMES = 64
#: A frame that a controller gives once more, because it did not see it acknowledged, comes within some three frames.
_REPEATED_BITS = 500


class Exchange:
    """The loop's own connection to the bus: which frame belongs to which device, and which to nobody here.

    A connection never hears its own frames. So what has the identifier of a master comes from another one, from
    whatever machine. Of each synchronous frame of the nodes one is owed for each SYNC, or for each n-th; one more is
    foreign. So is a PDO of theirs that was switched off.
    """

    def __init__(self, bus: Bus, clock: Clock, amplifier: Amplifier, encoder: Encoder, plan: LoopPlan) -> None:
        """Frames of other nodes are read and dropped."""
        self._bus, self._clock = bus, clock
        self._receivers = {i: device for device in (amplifier, encoder) for i in device.receive_ids}
        self._sync_frames = amplifier.sync_frames + encoder.sync_frames
        self._amplifier_id = plan.amplifier.node_id
        self._heartbeat_id = HEARTBEAT_BASE + plan.config.heartbeat.master_node_id
        self._foreign_ids = dict.fromkeys(_master_ids(plan), _SECOND_MASTER)
        self._foreign_ids |= dict.fromkeys(_unplanned_ids(plan), _FOREIGN_FEEDBACK)
        repeated_ns = _REPEATED_BITS * NS_PER_S // plan.config.bus.bit_rate
        nodes = [[pdo for pdo in node.pdos if not pdo.receive] for node in (plan.amplifier, plan.encoder)]
        self._answers = Answers((pdo.cob_id for sent in nodes for pdo in sent if pdo.syncs == 1), repeated_ns)
        rare = {i: row for sent in nodes for i, row in _rare(sent).items()}
        self._rare = Rare(rare, self._answers, repeated_ns)
        self._rare_bytes = {pdo.cob_id: pdo.data_bytes for sent in nodes for pdo in sent if pdo.syncs != 1}
        self._foreign = 0  # fault bits of what others sent, since the last look
        self.late_frames = 0
        self._queue_full = self._bus_off_events = self._down_events = 0
        self.sync_ns = clock.now_ns()

    def sync(self) -> int:
        """Take what came since the last cycle, send SYNC, and return the moment of it: all feedback is sampled then."""
        self._drain()
        self.sync_ns = self._clock.now_ns()
        if self._bus.send(SYNC_ID, b""):
            self._answers.ask(self.sync_ns)
        return self.sync_ns

    def collect(self, until_ns: int) -> None:
        """Wait for this SYNC's feedback, at the longest until `until_ns`; what lies in the socket then is still taken.

        On a machine that is slow for a moment the time may be over while the answer is already there.
        """
        clock, bus, sync_ns, answers = self._clock, self._bus, self.sync_ns, self._answers
        answered: set[int] = set()  # two of one kind, a late one or a repeated one, are no answer of the other node
        for _ in range(MAX_FRAMES):
            remaining_ns = until_ns - clock.now_ns()
            frame = bus.receive(max(remaining_ns, 0) / NS_PER_S)
            if frame is None:
                return
            if frame.can_id in answers.kinds and not answers.take(frame):
                self._foreign |= _FOREIGN_FEEDBACK
            receiver = self._receivers.get(frame.can_id)
            if receiver is not None and receiver.on_frame(frame.can_id, frame.data, sync_ns):
                answered.add(frame.can_id)
                if len(answered) == self._sync_frames:
                    answers.complete()
                    return
            else:
                self._look_at(frame)

    def send(self, can_id: int, data: bytes) -> None:
        """Queue the torque frame; a full queue is counted and seen in `faults`."""
        self._bus.send(can_id, data)

    def send_last(self, can_id: int, data: bytes) -> None:
        """A last command with the SYNC behind it that it acts at: nobody sends another."""
        self._bus.send(can_id, data)
        self._bus.send(SYNC_ID, b"")

    def heartbeat(self) -> None:
        """The master's heartbeat: when this process dies, the drive notices."""
        self._bus.send(self._heartbeat_id, _OPERATIONAL)

    def stop_drive(self) -> None:
        """NMT stop to the amplifier. From now on the supervisor stops it by NMT, too, and is no other master."""
        self._foreign_ids.pop(NMT_ID, None)
        self._bus.send(NMT_ID, bytes((NmtCommand.STOP, self._amplifier_id)))

    def make_drive_answer(self) -> None:
        """NMT pre-operational to the amplifier: no PDO, but SDO."""
        self._bus.send(NMT_ID, bytes((NmtCommand.PRE_OPERATIONAL, self._amplifier_id)))

    def faults(self) -> int:
        """What is wrong with the bus, or was since the last call however shortly, as fault bits."""
        counters, faults = self._bus.counters, 0
        if counters.bus_off or counters.bus_off_events != self._bus_off_events:
            self._bus_off_events = counters.bus_off_events
            faults |= _BUS_OFF
        if counters.down or counters.down_events != self._down_events:
            self._down_events = counters.down_events
            faults |= _BUS_DOWN
        if counters.queue_full != self._queue_full:
            self._queue_full = counters.queue_full
            faults |= _QUEUE_FULL
        faults |= self._foreign
        self._foreign = 0
        return faults

    def counts(self) -> tuple[int, int]:
        """Frames that could not be queued, and error frames seen."""
        return self._bus.counters.queue_full, self._bus.counters.error_frames

    def _drain(self) -> None:
        """Frames from between the cycles. Feedback of the previous SYNC that comes now is dropped and counted: taken,
        it would pass for fresh, and a bus that is always a little late would look well. One that comes only after the
        next SYNC cannot be told from an answer to that; the mismatch of both encoders and the speed limit remain."""
        for _ in range(MAX_FRAMES):
            frame = self._bus.receive(0.0)
            if frame is None:
                return
            receiver = self._receivers.get(frame.can_id)
            if frame.can_id in self._answers.kinds:
                self._foreign |= 0 if self._answers.take(frame) else _FOREIGN_FEEDBACK
                self.late_frames += 1
                continue
            if receiver is not None:
                receiver.on_frame(frame.can_id, frame.data, self.sync_ns)
            self._look_at(frame)

    def _look_at(self, frame: Frame) -> None:
        """What does not come with each SYNC: of a master, switched off, too soon, or shorter than the node's own."""
        self._foreign |= self._foreign_ids.get(frame.can_id, 0)
        short = len(frame.data) < self._rare_bytes.get(frame.can_id, 0)
        if short or (frame.can_id in self._rare and not self._rare.take(frame)):
            self._foreign |= _FOREIGN_FEEDBACK


def _master_ids(plan: LoopPlan) -> set[int]:
    """What only masters send, and the planned command PDOs. SDO is the supervisor's."""
    nodes = (plan.amplifier, plan.encoder)
    planned = {pdo.cob_id for node in nodes for pdo in node.pdos if pdo.receive}
    return planned | ids_of_masters([node.node_id for node in nodes], plan.config.heartbeat.master_node_id)


def _unplanned_ids(plan: LoopPlan) -> set[int]:
    """Identifiers of the nodes' other TPDOs, in CiA 301's predefined set: the bring-up has switched these off."""
    nodes = (plan.amplifier, plan.encoder)
    return {base + node.node_id for base in TPDO_BASE for node in nodes} - {p.cob_id for n in nodes for p in n.pdos}


def _rare(sent: Sequence[PdoMap]) -> dict[int, tuple[int, int]]:
    """Of one node's TPDOs those that come with every n-th SYNC: n, and the identifier of one that comes with each."""
    each = [pdo.cob_id for pdo in sent if pdo.syncs == 1]
    return {pdo.cob_id: (pdo.syncs, each[0]) for pdo in sent if pdo.syncs > 1 and each}
