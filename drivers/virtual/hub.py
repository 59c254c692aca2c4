"""The virtual CAN bus: arbitration by identifier, bit time, queues, error counters, faults on demand.

Every frame of the virtual world passes here. Frames wait in the queue of their port, as in a controller's mailbox in
order of sending; when the bus is free, the lowest identifier among the queue heads wins, takes its bit time, and
reaches all other ports at its end. Driven by the world: `step` completes at most one frame, so that timers keep order.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

from servod.common.units import NS_PER_S
from servod.drivers.virtual.bus_faults import ANY_ID, FaultKind
from servod.drivers.virtual.port import ErrorState, Port
from servod.drivers.virtual.timeline import NEVER, Timeline
from servod.runtime.fieldbus.bus import CAN_EFF_FLAG, CAN_RTR_FLAG

# --- Faults of single frames -----------------------------------------------------------------------------------------
# Faults that hit single frames: what becomes of the next frames with an identifier. Asked by the hub for each frame
# that ends, while a fault is armed or a frame is held back.


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


# --- Frames on the wire ----------------------------------------------------------------------------------------------
# How long a frame takes on the wire, and who wins arbitration (ISO 11898-1). Lengths take the worst case of bit
# stuffing, from a table by data length, because counting the stuff bits of every frame would cost more than everything
# else that the hub does; a bus that fits here fits in reality.


#: Bits of a base-format data frame with n data bytes: 8n+47 (with interframe space) and the stuff bits of 34+8n bits.
STANDARD_BITS = tuple(8 * n + 47 + (33 + 8 * n) // 4 for n in range(9))
#: The same for the extended format, whose stuffed part is 20 bits longer.
EXTENDED_BITS = tuple(8 * n + 67 + (53 + 8 * n) // 4 for n in range(9))
#: Error flag, delimiter and interframe space that follow a destroyed frame.
ERROR_BITS = 23


def frame_bits(can_id: int, data_bytes: int) -> int:
    """Worst-case length of a frame in bits; `can_id` with the kernel's flags."""
    length = 0 if can_id & CAN_RTR_FLAG else data_bytes
    return EXTENDED_BITS[length] if can_id & CAN_EFF_FLAG else STANDARD_BITS[length]


def arbitration_key(can_id: int) -> int:
    """The number that arbitration compares; the lowest wins. Base before extended, data before remote."""
    if can_id <= 0x7FF:
        return can_id << 21
    remote = 1 if can_id & CAN_RTR_FLAG else 0
    if can_id & CAN_EFF_FLAG:
        identifier = can_id & 0x1FFFFFFF
        return (identifier >> 18) << 21 | 1 << 20 | (identifier & 0x3FFFF) << 1 | remote
    return (can_id & 0x7FF) << 21 | remote << 19


def _arbitrated(port: Port) -> int:
    return arbitration_key(port.queue[0][0])


#: Looked up once: what an enumeration's member costs is paid with every frame.
_BUS_OFF, _CORRUPT = ErrorState.BUS_OFF, FaultKind.CORRUPT
#: What a destroyed frame adds to the transmitter's and the receivers' error counters.
TRANSMIT_ERROR_STEP, RECEIVE_ERROR_STEP = 8, 1


class Hub:
    """One bus at one bit rate [bit/s]."""

    def __init__(self, timeline: Timeline, bit_rate: int = 1_000_000) -> None:
        self._timeline = timeline
        self._bit_ns = NS_PER_S // bit_rate
        self._ports: tuple[Port, ...] = ()
        self._sender: Port | None = None
        self._frame: tuple[int, bytes, int] = (0, b"", 0)
        self._end_ns = 0  # of the frame on the wire, or of the last one
        self._waiting = 0
        self._errors = False  # some counter is not zero
        self.faults = FrameFaults()
        self.frames = 0
        self.busy_ns = 0

    @property
    def ports(self) -> tuple[Port, ...]:
        """All participants, in the order of joining."""
        return self._ports

    def attach(self, port: Port) -> Port:
        """Let `port` take part."""
        self._ports = (*self._ports, port)
        return port

    def detach(self, port: Port) -> None:
        """`port` leaves; its waiting frames vanish."""
        self._ports = tuple(other for other in self._ports if other is not port)
        self._waiting -= len(port.queue)
        port.queue.clear()
        if self._sender is port:
            self._sender = None

    def submit(self, port: Port, can_id: int, data: bytes, time_ns: int) -> bool:
        """Queue a frame of `port`; False when its queue is full or it is bus-off. A silenced port loses it unseen."""
        queue = port.queue
        if port.state is _BUS_OFF or len(queue) >= port.depth:
            port.dropped += 1
            return False
        if time_ns < port.silent_until_ns:
            port.silenced += 1
            return True
        ready_ns = time_ns + port.delay_ns
        ready_ns = max(ready_ns, port.stuck_until_ns)
        if ready_ns > time_ns:
            port.held += 1
        queue.append((can_id, data, ready_ns))
        self._waiting += 1
        return True

    def next_ns(self) -> int:
        """When the bus does something next: end of the frame on the wire, or start of the next; NEVER when idle."""
        if self._sender is not None:
            return self._end_ns
        return self._next_start_ns() if self._waiting else NEVER

    def step(self, limit_ns: int) -> bool:
        """Start frames and complete the first that ends by `limit_ns`; False when none does."""
        if self._sender is None and not (self._waiting and self._start(limit_ns)):
            return False
        if self._end_ns > limit_ns:
            return False
        self._complete()
        return True

    def force_bus_off(self, port: Port, time_ns: int) -> None:
        """Drive `port` to bus-off, as a broken transceiver would."""
        if port.count(256 * TRANSMIT_ERROR_STEP, 0, time_ns):
            self._bus_off(port, time_ns)

    def _next_start_ns(self) -> int:
        first_ns = NEVER
        for port in self._ports:
            queue = port.queue
            if queue and queue[0][2] < first_ns:
                first_ns = queue[0][2]
        return first_ns if first_ns > self._end_ns else self._end_ns

    def _start(self, limit_ns: int) -> bool:
        """Arbitrate at the next moment at which the bus is free and somebody waits."""
        winner, start_ns, several = None, NEVER, False
        for port in self._ports:
            queue = port.queue
            if queue:
                several = winner is not None
                winner = port
                start_ns = min(start_ns, queue[0][2])
        start_ns = max(start_ns, self._end_ns)
        if winner is None or start_ns > limit_ns:
            return False
        if several:
            winner = min([p for p in self._ports if p.queue and p.queue[0][2] <= start_ns], key=_arbitrated)
        self._sender, self._frame = winner, winner.queue[0]
        can_id, data, _ = self._frame
        duration_ns = (STANDARD_BITS[len(data)] if can_id <= 0x7FF else frame_bits(can_id, len(data))) * self._bit_ns
        self.busy_ns += duration_ns
        self._end_ns = start_ns + duration_ns
        return True

    def _complete(self) -> None:
        """The frame on the wire ended: deliver it, unless a fault hits it."""
        sender, (can_id, data, _), end_ns = self._sender, self._frame, self._end_ns
        assert sender is not None
        self._sender = None
        armed = self.faults.armed
        strike = self.faults.strike(can_id) if armed else UNHURT
        if armed and strike.kind is _CORRUPT:
            self._destroyed(sender, end_ns)
            return
        sender.queue.popleft()
        self._waiting -= 1
        sender.sent += 1
        self.frames += 1
        if self._errors:
            self._forgive(sender, end_ns)
        if armed:
            for delivery in self.faults.deliveries(strike, can_id, data):
                self._deliver_later(sender, can_id, delivery, end_ns)
        else:
            self._deliver(sender, can_id, data, end_ns)

    def _deliver(self, sender: Port, can_id: int, data: bytes, end_ns: int) -> None:
        for port in self._ports:
            if port is sender or port.state is _BUS_OFF:
                continue
            if port.silent_until_ns <= end_ns:
                port.receive(can_id, data, end_ns)
            else:
                port.silenced += 1

    def _deliver_later(self, sender: Port, can_id: int, delivery: Delivery, end_ns: int) -> None:
        """Of a frame that a fault hit: now, or when its time has come."""
        if delivery.delay_ns:
            deliver = partial(self._deliver, sender, can_id, delivery.data)
            self._timeline.timer(deliver).arm(end_ns + delivery.delay_ns)
        else:
            self._deliver(sender, can_id, delivery.data, end_ns)

    def _destroyed(self, sender: Port, time_ns: int) -> None:
        """Error frame: count on both sides; the frame stays at the head of its queue and is sent again."""
        self._errors = True
        self._end_ns += ERROR_BITS * self._bit_ns
        for port in self._ports:
            if port is not sender:
                port.count(0, RECEIVE_ERROR_STEP, time_ns)
        if sender.count(TRANSMIT_ERROR_STEP, 0, time_ns):
            self._bus_off(sender, time_ns)

    def _forgive(self, sender: Port, time_ns: int) -> None:
        """Every good frame takes one from the counters."""
        for port in self._ports:
            if port.state is not ErrorState.BUS_OFF:
                port.count(-1 if port is sender else 0, 0 if port is sender else -1, time_ns)
        self._errors = any(port.transmit_errors or port.receive_errors for port in self._ports)

    def _bus_off(self, port: Port, time_ns: int) -> None:
        self._errors = True
        self._waiting -= len(port.queue)
        port.queue.clear()
        if self._sender is port:
            self._sender = None
        if port.restart_ns:
            self._timeline.timer(port.restart).arm(time_ns + port.restart_ns)
