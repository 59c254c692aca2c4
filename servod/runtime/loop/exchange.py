"""Frames of one cycle: SYNC out, feedback in, torque and heartbeat out. Only this file knows the bus."""

from __future__ import annotations

from servod.common.clock import Clock
from servod.common.faults import FAULTS, FaultCode
from servod.common.units import NS_PER_S
from servod.runtime.fieldbus.bus import Bus
from servod.runtime.fieldbus.cia import HEARTBEAT_BASE, NMT_ID, SYNC_ID, NmtCommand, NmtState
from servod.runtime.fieldbus.devices import Amplifier, Encoder, NodePlan
from servod.runtime.loop.plan import LoopPlan

_BUS_OFF, _BUS_DOWN, _QUEUE_FULL, _SECOND_MASTER = (
    FAULTS[c].bit for c in (FaultCode.BUS_OFF, FaultCode.BUS_DOWN, FaultCode.BUS_QUEUE_FULL, FaultCode.SECOND_MASTER)
)
_OPERATIONAL = bytes([NmtState.OPERATIONAL])
#: A cycle takes at most this many frames from the socket, so that a babbling node cannot hold the loop.
MAX_FRAMES = 64


class Exchange:
    """The loop's own connection to the bus, and which frame belongs to which device."""

    def __init__(self, bus: Bus, clock: Clock, amplifier: Amplifier, encoder: Encoder, plan: LoopPlan) -> None:
        """Frames of other nodes are read and dropped."""
        self._bus, self._clock = bus, clock
        self._receivers = {i: device for device in (amplifier, encoder) for i in device.receive_ids}
        self._sync_frames = amplifier.sync_frames + encoder.sync_frames
        self._sync_ids = _synchronous_ids(plan.amplifier) | _synchronous_ids(plan.encoder)
        self._amplifier_id = plan.amplifier.node_id
        self._heartbeat_id = HEARTBEAT_BASE + plan.config.heartbeat.master_node_id
        self._ours = frozenset({SYNC_ID, self._heartbeat_id, *(p.cob_id for p in plan.amplifier.pdos if p.receive)})
        self._others_frames = 0  # with identifiers that are ours, since the last look
        self.late_frames = 0
        self._queue_full = self._bus_off_events = self._down_events = 0
        self.sync_ns = clock.now_ns()

    def sync(self) -> int:
        """Take what came since the last cycle, send SYNC, and return the moment of it: all feedback is sampled then."""
        self._drain()
        self.sync_ns = self._clock.now_ns()
        self._bus.send(SYNC_ID, b"")
        return self.sync_ns

    def collect(self, until_ns: int) -> None:
        """Wait for this SYNC's feedback, at the longest until `until_ns`; what lies in the socket then is still taken.

        On a machine that is slow for a moment the time may be over while the answer is already there.
        """
        missing, clock, bus, sync_ns = self._sync_frames, self._clock, self._bus, self.sync_ns
        for _ in range(MAX_FRAMES):
            remaining_ns = until_ns - clock.now_ns()
            frame = bus.receive(max(remaining_ns, 0) / NS_PER_S)
            if frame is None:
                return
            receiver = self._receivers.get(frame.can_id)
            if receiver is not None and receiver.on_frame(frame.can_id, frame.data, sync_ns):
                missing -= 1
                if missing == 0:
                    return
            elif receiver is None and frame.can_id in self._ours:
                self._others_frames += 1

    def send(self, can_id: int, data: bytes) -> None:
        """Queue the torque frame; a full queue is counted and seen in `faults`."""
        self._bus.send(can_id, data)

    def heartbeat(self) -> None:
        """The master's heartbeat: when this process dies, the drive notices."""
        self._bus.send(self._heartbeat_id, _OPERATIONAL)

    def stop_drive(self) -> None:
        """NMT stop to the amplifier."""
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
        if self._others_frames:
            self._others_frames = 0
            faults |= _SECOND_MASTER
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
            if frame.can_id in self._sync_ids:
                self.late_frames += 1
            elif receiver is not None:
                receiver.on_frame(frame.can_id, frame.data, self.sync_ns)
            elif frame.can_id in self._ours:
                self._others_frames += 1


def _synchronous_ids(plan: NodePlan) -> frozenset[int]:
    """COB-IDs of the TPDOs that answer a SYNC (transmission types 0 to 240)."""
    return frozenset(p.cob_id for p in plan.pdos if not p.receive and p.transmission_type <= 240)
