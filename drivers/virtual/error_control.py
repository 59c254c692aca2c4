"""How a node tells that it lives and what is wrong: heartbeat in both directions, producer 0x1017 and consumer 0x1016
(CiA 301, 7.2.8.3.2), and EMCY frames with error register 0x1001, error history 0x1003, inhibit time 0x1015.

The heartbeat consumer is the drive's last line of defence: it notices that the master's loop is dead. Supervision of a
node starts with its first heartbeat. Errors are raised by the PDO engine, the heartbeat consumer and the application.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable

from servod.drivers.virtual.dictionary import DeviceDictionary, Entry, SdoRefusal
from servod.drivers.virtual.timeline import Timeline, Timer
from servod.runtime.fieldbus.cia import HEARTBEAT_BASE, Abort, Emcy, NmtState, Obj301

NS_PER_MS = 1_000_000

_FRAME = struct.Struct("<HB5s")
_HISTORY = 8
_WAITING_LIMIT = 16
#: Error register bit by the class of the code (its high nibble): CiA 301, object 0x1001 and the EMCY code classes.
_REGISTER_BIT = {0x2: 0x02, 0x3: 0x04, 0x4: 0x08, 0x8: 0x10, 0xF: 0x80}


class Emergency:
    """Errors that are present, and what the bus hears of them. `send(can_id, data)`; False when it may not be sent."""

    def __init__(self, dictionary: DeviceDictionary, send: Callable[[int, bytes], object], timeline: Timeline) -> None:
        self._dictionary, self._send = dictionary, send
        self._present: dict[int, int] = {}
        self._waiting: deque[bytes] = deque(maxlen=_WAITING_LIMIT)
        self._inhibit = timeline.timer(self._inhibit_over)
        self._register = dictionary.entry(Obj301.ERROR_REGISTER)
        self._history = [dictionary.entry(Obj301.ERROR_HISTORY, i) for i in range(_HISTORY + 1)]
        self._history[0].check = _only_zero
        self._history[0].written = self._clear_history
        for number, entry in enumerate(self._history[1:], start=1):
            entry.read = self._history_reader(number)

    def reset(self) -> None:
        """Forget present errors (reset of the node); the history stays."""
        self._present.clear()
        self._waiting.clear()
        self._inhibit.cancel()
        self._register.value = 0

    def present(self, code: int) -> bool:
        """True while `code` is raised."""
        return code in self._present

    def set(self, code: int, time_ns: int, detail: bytes = b"") -> None:
        """Raise `code`, once; `detail`: up to five bytes of the maker."""
        if code in self._present:
            return
        self._present[code] = _REGISTER_BIT.get(code >> 12, 0) | 0x01
        self._remember(code)
        self._announce(code, detail, time_ns)

    def clear(self, code: int, time_ns: int) -> None:
        """Take `code` back; the bus hears 0x0000 with what is left in the error register."""
        if self._present.pop(code, None) is not None:
            self._announce(Emcy.NONE, b"", time_ns)

    def _announce(self, code: int, detail: bytes, time_ns: int) -> None:
        register = 0
        for bits in self._present.values():
            register |= bits
        self._register.value = register
        self._waiting.append(_FRAME.pack(code, register, detail))
        if not self._inhibit.armed:
            self._inhibit_over(time_ns)

    def _inhibit_over(self, time_ns: int) -> None:
        """Send the oldest waiting frame and start the inhibit time again; without one, send all."""
        identifier = self._dictionary.value(Obj301.EMCY_COB_ID)
        inhibit_ns = self._dictionary.value(Obj301.EMCY_INHIBIT) * 100_000
        while self._waiting:
            data = self._waiting.popleft()
            if not identifier & 0x80000000:
                self._send(identifier & 0x7FF, data)
            if inhibit_ns:
                self._inhibit.arm(time_ns + inhibit_ns)
                return

    def _remember(self, code: int) -> None:
        for older in range(_HISTORY, 1, -1):
            self._history[older].value = self._history[older - 1].value
        self._history[1].value = code
        self._history[0].value = min(self._history[0].value + 1, _HISTORY)

    def _clear_history(self, value: int) -> None:
        for entry in self._history:
            entry.value = 0

    def _history_reader(self, number: int) -> Callable[[], None]:
        def refuse_empty() -> None:
            if number > self._history[0].value:
                raise SdoRefusal(Abort.NO_DATA)

        return refuse_empty


def _only_zero(value: int) -> None:
    if value:
        raise SdoRefusal(Abort.VALUE_RANGE)


class HeartbeatProducer:
    """Sends the NMT state every 0x1017 ms through `send(time_ns)`."""

    def __init__(self, dictionary: DeviceDictionary, send: Callable[[int], None], timeline: Timeline) -> None:
        self._entry = dictionary.entry(Obj301.HEARTBEAT_PRODUCER)
        self._send = send
        self._timer = timeline.timer(self._due)

    def restart(self, time_ns: int) -> None:
        """Take over a new period; the first heartbeat comes one period from now."""
        period_ns = self._entry.value * NS_PER_MS
        if period_ns:
            self._timer.arm(time_ns + period_ns)
        else:
            self._timer.cancel()

    def stop(self) -> None:
        """Send no more."""
        self._timer.cancel()

    def _due(self, time_ns: int) -> None:
        self._send(time_ns)
        self.restart(time_ns)


class HeartbeatConsumer:
    """Watches the nodes named in 0x1016. `lost(node_id, time_ns)` is called once when one falls silent or resets,
    `found(node_id, time_ns)` when it is heard again."""

    def __init__(
        self,
        dictionary: DeviceDictionary,
        timeline: Timeline,
        lost: Callable[[int, int], None],
        found: Callable[[int, int], None],
    ) -> None:
        count = dictionary.value(Obj301.HEARTBEAT_CONSUMER)
        self._entries = [dictionary.entry(Obj301.HEARTBEAT_CONSUMER, i) for i in range(1, count + 1)]
        for entry in self._entries:
            entry.check = self._checker(entry)
        self._timeline, self._lost, self._found = timeline, lost, found
        self._watched: dict[int, tuple[int, Timer]] = {}
        self._silent: set[int] = set()

    def configure(self) -> None:
        """Take over 0x1016; supervision begins again, with the next heartbeat of each node."""
        for _, timer in self._watched.values():
            timer.cancel()
        self._watched.clear()  # the silent stay it until they are heard: so long their EMCY stands
        for entry in self._entries:
            node_id, time_ms = entry.value >> 16 & 0x7F, entry.value & 0xFFFF
            if node_id and time_ms:
                self._watched[node_id] = (time_ms * NS_PER_MS, self._timeline.timer(self._expiry(node_id)))

    def identifiers(self) -> list[int]:
        """COB-IDs of the heartbeats that are watched."""
        return [HEARTBEAT_BASE + node_id for node_id in self._watched]

    def heard(self, node_id: int, data: bytes, time_ns: int) -> None:
        """A heartbeat came; a boot-up of a node that was alive means that it was reset, and counts as lost."""
        period_ns, timer = self._watched[node_id]
        if data[:1] == bytes((NmtState.BOOT_UP,)):
            if timer.armed:
                timer.cancel()
                self._silence(node_id, time_ns)
            return
        timer.arm(time_ns + period_ns)
        if node_id in self._silent:
            self._silent.discard(node_id)
            self._found(node_id, time_ns)

    def _expiry(self, node_id: int) -> Callable[[int], None]:
        return lambda time_ns: self._silence(node_id, time_ns)

    def _silence(self, node_id: int, time_ns: int) -> None:
        self._silent.add(node_id)
        self._lost(node_id, time_ns)

    def _checker(self, entry: Entry) -> Callable[[int], None]:
        def refuse_duplicate(value: int) -> None:
            """CiA 301: two entries for one node are incompatible."""
            node_id = value >> 16 & 0x7F
            others = (e.value for e in self._entries if e is not entry and e.value & 0xFFFF)
            if node_id and value & 0xFFFF and any(other >> 16 & 0x7F == node_id for other in others):
                raise SdoRefusal(Abort.INCOMPATIBLE_PARAMETER)

        return refuse_duplicate
