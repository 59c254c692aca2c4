"""The canopen library on a servod Bus: frames go out through the bus, and come in because we pump them.

No python-can Notifier and no periodic tasks. With a wall clock one reader thread of our own pumps; with a virtual
clock nobody else runs, so every wait pumps the bus itself, and time advances by that. Off the control path.
"""

from __future__ import annotations

import threading
from collections import defaultdict, deque
from collections.abc import Callable, Iterable

import canopen

from servod.common.clock import Clock
from servod.common.errors import Unreachable
from servod.common.units import NS_PER_S
from servod.runtime.fieldbus.bus import CAN_EFF_FLAG, CAN_RTR_FLAG, Bus
from servod.runtime.fieldbus.cia import LSS_FROM_SLAVE_ID, SDO_ANSWER_BASE, SDO_REQUEST_BASE

_READER_WAIT_S = 0.05  # how long the reader thread stays in one receive: bounds the time that closing takes

#: No more answers than this are waited for, and none for longer: it was lost, or its node is not there.
_MOST_OWED, _OWED_NS = 64, 5 * NS_PER_S
_SDO_ABORT = 4  # command specifier, the upper three bits of the first byte: nobody answers it (CiA 301, 7.2.4.3.17)


class SdoAnswers:
    """The answers that the nodes owe for our requests, each at most one; and the requests of our other connections."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._asked_ns: defaultdict[int, deque[int]] = defaultdict(lambda: deque(maxlen=_MOST_OWED))
        self._announced_ns: defaultdict[tuple[int, bytes], deque[int]] = defaultdict(lambda: deque(maxlen=_MOST_OWED))
        self._lock = threading.Lock()

    def asked(self, can_id: int, data: bytes) -> None:
        """A frame of ours goes out on some connection; a request of SDO is owed an answer from now on."""
        node_id = can_id - SDO_REQUEST_BASE
        if 0 < node_id < 0x80 and data and data[0] >> 5 != _SDO_ABORT:
            self._asked_ns[node_id].append(self._clock.now_ns())

    def answered(self, can_id: int) -> bool:
        """An answer came; False when none was owed."""
        asked_ns = self._asked_ns[can_id - SDO_ANSWER_BASE]
        while asked_ns and asked_ns[0] < self._clock.now_ns() - _OWED_NS:
            asked_ns.popleft()
        if not asked_ns:
            return False
        asked_ns.pop()  # the newest: one that was lost grows old, whatever is asked after it
        return True

    def announce(self, can_id: int, data: bytes) -> None:
        """Another connection of ours is about to send this, which will be heard here."""
        with self._lock:
            self._announced_ns[can_id, data].append(self._clock.now_ns())

    def withdraw(self, can_id: int, data: bytes) -> None:
        """The bus did not take what was announced."""
        with self._lock:
            if announced_ns := self._announced_ns[can_id, data]:
                announced_ns.pop()

    def own(self, can_id: int, data: bytes, heard_late: bool = False) -> bool:
        """A request was heard; whether it is one of ours, which is owed its answer then.

        What was announced long ago never reached the bus, and shall not excuse somebody else's; unless frames wait for
        whoever hears them, as at the start (`heard_late`).
        """
        with self._lock:
            announced_ns = self._announced_ns[can_id, data]
            while announced_ns and not heard_late and announced_ns[0] < self._clock.now_ns() - _OWED_NS:
                announced_ns.popleft()
            if not announced_ns:
                del self._announced_ns[can_id, data]
                return False
            announced_ns.popleft()
        self.asked(can_id, data)
        return True


class AnnouncedBus:
    """A further connection of this process, whose frames its master shall not take for somebody else's."""

    def __init__(self, bus: Bus, network: BusNetwork) -> None:
        self._bus, self._network = bus, network
        self.counters = bus.counters
        self.receive, self.fileno = bus.receive, bus.fileno
        network.shared.add(self)

    def close(self) -> None:
        """Leave the bus; the master has it for itself again."""
        self._network.shared.discard(self)
        self._bus.close()

    def send(self, can_id: int, data: bytes) -> bool:
        """As the bus does, announced where the master listens to it."""
        listens = can_id in self._network.subscribers
        if listens:
            self._network.answers.announce(can_id, data)
        sent = self._bus.send(can_id, data)
        if listens and not sent:
            self._network.answers.withdraw(can_id, data)
        return sent


class BusNetwork(canopen.Network):
    """canopen.Network over servod.runtime.fieldbus.bus.Bus; see the module for who pumps it."""

    def __init__(self, bus: Bus, clock: Clock, threaded: bool) -> None:
        super().__init__()
        self.unsubscribe(LSS_FROM_SLAVE_ID)  # canopen's own LSS master, which nobody asks, would keep every answer
        self._servod_bus = bus
        self.clock = clock
        self.answers = SdoAnswers(clock)
        self.shared: set[AnnouncedBus] = set()  # further connections of this process that are open
        self.announces: set[int] = set()  # what another connection of this process listens to, and we may send
        self._arrived = threading.Condition()
        self._closing = False
        self.broken: Exception | None = None  # what ended the reader thread, if anything did
        self._reader = threading.Thread(target=self._read, name="canopen-reader", daemon=True) if threaded else None
        if self._reader is not None:
            self._reader.start()

    def send_message(self, can_id: int, data: bytes | Iterable[int], remote: bool = False) -> None:
        """Queue one frame; raises Unreachable when the bus does not take it."""
        with self.send_lock:
            self.answers.asked(can_id, bytes(data))
            if can_id in self.announces:
                self.answers.announce(can_id, bytes(data))
            sent = self._servod_bus.send(can_id | (CAN_RTR_FLAG if remote else 0), bytes(data))
        if not sent:
            if can_id in self.announces:
                self.answers.withdraw(can_id, bytes(data))
            counters = self._servod_bus.counters
            state = "bus-off" if counters.bus_off else "down" if counters.down else "full queue"
            raise Unreachable(f"bus: frame 0x{can_id:03X} could not be sent ({state})")

    def pump(self, timeout_s: float) -> bool:
        """Take one frame from the bus and hand it to whoever listens; False when none came in time."""
        frame = self._servod_bus.receive(timeout_s)
        if frame is None:
            return False
        if not frame.can_id & (CAN_RTR_FLAG | CAN_EFF_FLAG):
            self.notify(frame.can_id, bytearray(frame.data), frame.time_ns)
        return True

    def wait(self, done: Callable[[], bool], timeout_s: float) -> bool:
        """Wait until `done()` holds, at most `timeout_s` on this network's clock; False when the time ran out."""
        if self._reader is not None:
            with self._arrived:
                return self._arrived.wait_for(done, timeout_s)
        deadline_ns = self.clock.now_ns() + round(timeout_s * NS_PER_S)
        while not done():
            remaining_ns = deadline_ns - self.clock.now_ns()
            if remaining_ns <= 0:
                return False
            self.pump(remaining_ns / NS_PER_S)
        return True

    def drain(self) -> None:
        """Take all frames that wait, without waiting for more; a no-op when the reader thread does it."""
        while self._reader is None and self.pump(0.0):
            pass

    def _read(self) -> None:
        try:
            while not self._closing:
                if self.pump(_READER_WAIT_S):
                    with self._arrived:
                        self._arrived.notify_all()
        except Exception as error:  # kept and shown by Master.poll: a thread must never die silently
            self.broken = error

    def disconnect(self) -> None:
        """Stop the reader and leave the bus."""
        self._closing = True
        if self._reader is not None and self._reader is not threading.current_thread():
            self._reader.join(timeout=20 * _READER_WAIT_S)
        self._servod_bus.close()
