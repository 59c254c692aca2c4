"""Heartbeat of a node in both directions: producer 0x1017 and consumer 0x1016 (CiA 301, 7.2.8.3.2).

The consumer is the drive's last line of defence: it notices that the master's loop is dead. Supervision of a node
starts with its first heartbeat.
"""

from __future__ import annotations

from collections.abc import Callable

from servod.drivers.virtual.dictionary import DeviceDictionary, Entry, SdoRefusal
from servod.drivers.virtual.timeline import Timeline, Timer
from servod.runtime.fieldbus.cia import HEARTBEAT_BASE, Abort, NmtState, Obj301

NS_PER_MS = 1_000_000


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
        """Take over 0x1016; supervision begins anew, with the next heartbeat of each node."""
        for _, timer in self._watched.values():
            timer.cancel()
        self._watched.clear()
        self._silent.clear()
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
