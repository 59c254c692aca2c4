"""All PDOs of one node, and the order of things at SYNC.

Used by the node for every SYNC and RPDO frame while it is operational.
"""

from __future__ import annotations

from collections.abc import Callable

from servod.drivers.virtual.dictionary import Dictionary, Entry
from servod.drivers.virtual.emergency import Emergency
from servod.drivers.virtual.pdo import Application, Rpdo, Tpdo
from servod.drivers.virtual.timeline import Timeline
from servod.runtime.fieldbus.cia import Emcy, Obj301

_PDOS = 4


class PdoEngine:
    """RPDO 1-4 and TPDO 1-4, as far as the dictionary has them."""

    def __init__(
        self,
        dictionary: Dictionary,
        timeline: Timeline,
        emergency: Emergency,
        send: Callable[[int, bytes, int], object],
        application: Application,
    ) -> None:
        self._application, self._emergency = application, emergency
        self._overflow = dictionary.entry(Obj301.SYNC_OVERFLOW)
        receive = [n for n in range(_PDOS) if dictionary.has(Obj301.RPDO_PARAMETER + n, 1)]
        self.rpdos = [Rpdo(n, dictionary, emergency, timeline) for n in receive]
        self.tpdos = [Tpdo(n, dictionary, timeline, send) for n in range(_PDOS)]
        self._now_ns = 0
        self.active = False
        self.on_change: Callable[[], None] = lambda: None
        for pdo in (*self.rpdos, *self.tpdos):
            pdo.on_change = self._changed
        self._sync_tpdos: list[Tpdo] = []
        self._by_id: dict[int, Rpdo] = {}

    def configure(self) -> None:
        """Take over all parameters and mappings."""
        for pdo in (*self.rpdos, *self.tpdos):
            pdo.configure()
        self._index()

    def start(self, time_ns: int) -> None:
        """The node became operational."""
        self.active = True
        for tpdo in self.tpdos:
            tpdo.start(time_ns, self._application.refresh)

    def stop(self) -> None:
        """The node left operational."""
        self.active = False
        for rpdo in self.rpdos:
            rpdo.stop()
        for tpdo in self.tpdos:
            tpdo.stop()

    def identifiers(self) -> tuple[list[int], list[int]]:
        """COB-IDs of the valid RPDOs, and of the valid TPDOs (for remote requests)."""
        return list(self._by_id), [t.cob_id for t in self.tpdos if t.valid]

    def on_sync(self, data: bytes, time_ns: int) -> None:
        """SYNC: sample and send, then apply what came since the last one."""
        self._now_ns = time_ns
        counter = self._counter(data, time_ns)
        self._application.refresh(time_ns)
        for tpdo in self._sync_tpdos:
            tpdo.on_sync(counter, time_ns)
        applied = False
        for rpdo in self.rpdos:
            applied |= rpdo.apply()
        if applied:
            self._application.commanded(time_ns)

    def on_rpdo(self, can_id: int, data: bytes, time_ns: int) -> None:
        """An RPDO came; event-driven ones act at once."""
        self._now_ns = time_ns
        rpdo = self._by_id[can_id]
        if rpdo.take(data, time_ns) and rpdo.apply():
            self._application.commanded(time_ns)

    def on_remote(self, can_id: int, time_ns: int) -> None:
        """A remote request for one of the TPDOs came."""
        for tpdo in self.tpdos:
            if tpdo.valid and tpdo.cob_id == can_id:
                tpdo.remote(time_ns)

    def changed(self, entries: tuple[Entry, ...], time_ns: int) -> None:
        """Application event for event-driven TPDOs."""
        if self.active:
            for tpdo in self.tpdos:
                tpdo.changed(entries, time_ns)

    def _counter(self, data: bytes, time_ns: int) -> int | None:
        """The SYNC counter; a length that does not fit 0x1019 is an emergency 8240."""
        if len(data) == (1 if self._overflow.value else 0):
            return data[0] if data else None
        self._emergency.set(Emcy.SYNC_LENGTH, time_ns)
        return None

    def _changed(self) -> None:
        self._index()
        self.on_change()

    def _index(self) -> None:
        self._by_id = {r.cob_id: r for r in self.rpdos if r.valid}
        self._sync_tpdos = [t for t in self.tpdos if t.valid and t.kind <= 252]
