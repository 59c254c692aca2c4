"""PDO engine of a node: takes RPDOs in, sends TPDOs, at SYNC, on event, by timer and on remote request.

Stands between the bus and the dictionary, in every cycle. At SYNC the synchronous TPDOs are sampled and sent first,
then the RPDOs that came since the last SYNC are applied, each as a whole: so an answer to a command is seen one SYNC
later. Packing is one precompiled struct for each PDO.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Protocol

from servod.drivers.virtual.dictionary import DeviceDictionary, Entry, SdoRefusal
from servod.drivers.virtual.error_control import Emergency
from servod.drivers.virtual.timeline import Timeline
from servod.runtime.fieldbus.cia import PDO_NO_RTR, PDO_NOT_VALID, Abort, Emcy, Obj301

# --- Rules of PDO parameters -----------------------------------------------------------------------------------------
# What may be written to PDO parameters and mappings, and when (CiA 301, 7.5.2.35 to 7.5.2.38). Hooks into the
# dictionary's entries 0x1400 to 0x1BFF. The order is forced: PDO not valid, sub 0 of the mapping to zero, entries, sub
# 0, PDO valid; anything else is refused with the abort code that the standard or the field uses.


_MAX_ENTRIES, _MAX_BITS = 8, 64
#: Identifiers that no PDO may use (CiA 301, table of restricted COB-IDs).
_RESTRICTED = (range(0x000, 0x080), range(0x101, 0x181), range(0x581, 0x600), range(0x601, 0x680), range(0x6E0, 0x800))


class PdoRules:
    """The rules of one PDO: `parameter` is 0x1400.. or 0x1800.., `mapping` 0x1600.. or 0x1A00...
    `changed()` is called after each accepted write."""

    def __init__(self, dictionary: DeviceDictionary, parameter: int, mapping: int, changed: Callable[[], None]) -> None:
        self._dictionary = dictionary
        self._receive = parameter < 0x1800
        self._cob = dictionary.entry(parameter, 1)
        self._count = dictionary.entry(mapping, 0)
        self._mapped = [dictionary.entry(mapping, i) for i in range(1, _MAX_ENTRIES + 1)]
        self._cob.check = self._check_cob
        dictionary.entry(parameter, 2).check = self._check_type
        self._count.check = self._check_count
        for entry in self._mapped:
            entry.check = self._check_mapped
        for subindex in (3, 6):
            if dictionary.has(parameter, subindex):
                dictionary.entry(parameter, subindex).check = self._refuse_while_valid
        for entry in dictionary:
            if entry.index in (parameter, mapping) and entry.writable:
                entry.written = lambda value: changed()

    @property
    def valid(self) -> bool:
        """True while the PDO exists (bit 31 clear)."""
        return not self._cob.value & PDO_NOT_VALID

    def _check_cob(self, value: int) -> None:
        if value & PDO_NOT_VALID:
            return
        if self.valid and value != self._cob.value:
            raise SdoRefusal(Abort.PRESENT_STATE)
        if value & 0x3FFFF800 or any(value & 0x7FF in restricted for restricted in _RESTRICTED):
            raise SdoRefusal(Abort.VALUE_RANGE)

    def _check_type(self, value: int) -> None:
        if 241 <= value <= 251 or (self._receive and value in (252, 253)):
            raise SdoRefusal(Abort.VALUE_RANGE)

    def _refuse_while_valid(self, value: int) -> None:
        if self.valid:
            raise SdoRefusal(Abort.PRESENT_STATE)

    def _check_mapped(self, word: int) -> None:
        """An entry may change only while the PDO is not valid and nothing counts as mapped."""
        if self.valid or self._count.value:
            raise SdoRefusal(Abort.PRESENT_STATE)
        if word:
            self._target(word)

    def _check_count(self, count: int) -> None:
        if self.valid:
            raise SdoRefusal(Abort.PRESENT_STATE)
        if count > _MAX_ENTRIES:
            raise SdoRefusal(Abort.VALUE_TOO_HIGH)
        if sum(self._target(entry.value).bits for entry in self._mapped[:count]) > _MAX_BITS:
            raise SdoRefusal(Abort.PDO_TOO_LONG)

    def _target(self, word: int) -> Entry:
        """The entry that a mapping word names; it must exist, be mappable in this direction and have that length."""
        target = self._dictionary.entry(word >> 16, word >> 8 & 0xFF)
        allowed = target.writable if self._receive else target.readable
        if not target.mappable or not allowed or target.bits != word & 0xFF:
            raise SdoRefusal(Abort.NOT_MAPPABLE)
        return target

    def targets(self) -> list[Entry]:
        """The entries that are mapped now, in order."""
        return [self._target(entry.value) for entry in self._mapped[: self._count.value]]


_CODES = {8: "b", 16: "h", 32: "i", 64: "q"}
_NS_PER_MS, _NS_PER_100US = 1_000_000, 100_000
_LAST_SYNCHRONOUS = 240
RTR_SYNCHRONOUS, RTR_ONLY = 252, 253


class Application(Protocol):
    """What the engine asks of the device behind it."""

    def refresh(self, time_ns: int) -> None:
        """Bring the dictionary's actual values up to `time_ns`."""

    def commanded(self, time_ns: int) -> None:
        """An RPDO was applied as a whole; judge it."""

    def commands_overdue(self, time_ns: int) -> None:
        """The deadline of an RPDO passed (0x1400:5); the EMCY is out."""


class Pdo:
    """What both directions share: parameters and the packing of the mapping, rebuilt after each change."""

    def __init__(self, dictionary: DeviceDictionary, parameter: int, mapping: int) -> None:
        self._dictionary, self._parameter = dictionary, parameter
        self._rules = PdoRules(dictionary, parameter, mapping, self._rebuild)
        self.valid = False
        self.cob_id = 0
        self.kind = 255  # transmission type
        self.event_ms = 0
        self.entries: list[Entry] = []
        self.packing = struct.Struct("<")
        self.on_change: Callable[[], None] = _nothing

    def configure(self) -> None:
        """Take over what stands in the dictionary."""
        cob = self._dictionary.value(self._parameter, 1)
        self.cob_id, self.valid = cob & 0x7FF, not cob & PDO_NOT_VALID
        self.kind = self._dictionary.value(self._parameter, 2)
        self.event_ms = self._dictionary.value(self._parameter, 5)
        self.entries = self._rules.targets()
        codes = (_CODES[e.bits] if e.signed else _CODES[e.bits].upper() for e in self.entries)
        self.packing = struct.Struct("<" + "".join(codes))

    def _rebuild(self) -> None:
        self.configure()
        self.on_change()


class Rpdo(Pdo):
    """One PDO that the node receives."""

    def __init__(
        self,
        number: int,
        dictionary: DeviceDictionary,
        emergency: Emergency,
        timeline: Timeline,
        overdue: Callable[[int], None],
    ) -> None:
        super().__init__(dictionary, 0x1400 + number, 0x1600 + number)
        self._emergency, self._overdue = emergency, overdue
        self._deadline = timeline.timer(self._missed)
        self._waiting: tuple[int, ...] | None = None
        self._wrong_length = False

    def configure(self) -> None:
        """As the dictionary says; supervision ends at once where the deadline is taken away."""
        super().configure()
        if not self.event_ms or not self.valid:
            self._deadline.cancel()

    def stop(self) -> None:
        """Leave operational: forget what waits, stop supervision."""
        self._waiting = None
        self._deadline.cancel()

    def take(self, data: bytes, time_ns: int) -> bool:
        """A frame came; True when it shall be applied now, not at SYNC."""
        if not self._fits(len(data), time_ns):
            return False
        self._waiting = self.packing.unpack_from(data)
        if self.event_ms:
            self._deadline.arm(time_ns + self.event_ms * _NS_PER_MS)
            self._emergency.clear(Emcy.RPDO_TIME_OUT, time_ns)
        return self.kind > _LAST_SYNCHRONOUS

    def _fits(self, length: int, time_ns: int) -> bool:
        """False for a frame that is too short, which is ignored; a wrong length is told once until one is right."""
        size = self.packing.size
        if length == size:
            if self._wrong_length:
                self._wrong_length = False
                self._emergency.clear(Emcy.PDO_LENGTH, time_ns)
                self._emergency.clear(Emcy.PDO_TOO_LONG, time_ns)
            return True
        self._wrong_length = True
        self._emergency.set(Emcy.PDO_LENGTH if length < size else Emcy.PDO_TOO_LONG, time_ns)
        return length > size

    def apply(self) -> bool:
        """Write the waiting values into the dictionary, all of them; values out of range leave theirs as it was."""
        values = self._waiting
        if values is None:
            return False
        self._waiting = None
        for entry, value in zip(self.entries, values, strict=True):
            if entry.low <= value <= entry.high:
                entry.value = value
        return True

    def _missed(self, time_ns: int) -> None:
        """The deadline passed: told, then the device reacts."""
        self._emergency.set(Emcy.RPDO_TIME_OUT, time_ns, self.cob_id.to_bytes(2, "little"))
        self._overdue(time_ns)


class Tpdo(Pdo):
    """One PDO that the node sends through `send(can_id, data, time_ns)`."""

    def __init__(
        self, number: int, dictionary: DeviceDictionary, timeline: Timeline, send: Callable[[int, bytes, int], object]
    ) -> None:
        super().__init__(dictionary, 0x1800 + number, 0x1A00 + number)
        self._send = send
        self._event = timeline.timer(self.trigger)
        self._inhibit = timeline.timer(self._inhibit_over)
        self._refresh: Callable[[int], None] = lambda time_ns: None
        self._owed = False
        self._syncs = 0
        self._last = b""

    def start(self, time_ns: int, refresh: Callable[[int], None]) -> None:
        """Enter operational: event-driven PDOs tell their state once, synchronous ones count from here."""
        self._refresh, self._syncs, self._last, self._owed = refresh, 0, b"", False
        if self.valid and self.kind >= 254:
            self.trigger(time_ns)

    def stop(self) -> None:
        """Leave operational."""
        self._event.cancel()
        self._inhibit.cancel()

    def on_sync(self, counter: int | None, time_ns: int) -> None:
        """Send when this SYNC is ours; the values are fresh. `counter`: of the SYNC frame, when it has one."""
        kind = self.kind
        if kind == 1:
            self._send(self.cob_id, self.packing.pack(*[e.value for e in self.entries]), time_ns)
        elif 1 < kind <= _LAST_SYNCHRONOUS:
            self._every_nth(kind, counter, time_ns)
        elif kind == 0 and self._owed:
            self._transmit(time_ns)
        elif kind == RTR_SYNCHRONOUS:
            self._last = self._packed()

    def changed(self, entries: tuple[Entry, ...], time_ns: int) -> None:
        """Application event: some of `entries` changed."""
        if not self.valid or (self.kind != 0 and self.kind < 254) or not any(e in self.entries for e in entries):
            return
        if self.kind == 0:
            self._owed = True
        else:
            self.trigger(time_ns)

    def remote(self, time_ns: int) -> None:
        """A remote request came."""
        if self._dictionary.value(self._parameter, 1) & PDO_NO_RTR:
            return
        if self.kind == RTR_SYNCHRONOUS:
            self._send(self.cob_id, self._last or self._packed(), time_ns)
        else:
            self._refresh(time_ns)
            self._transmit(time_ns)

    def trigger(self, time_ns: int) -> None:
        """Send now, or when the inhibit time is over."""
        if self._inhibit.armed:
            self._owed = True
            return
        self._refresh(time_ns)
        self._transmit(time_ns)

    def _every_nth(self, kind: int, counter: int | None, time_ns: int) -> None:
        start = self._dictionary.value(self._parameter, 6)
        if start and counter is not None and self._syncs == 0 and counter != start:
            return
        if self._syncs == 0 or self._syncs >= kind:
            self._syncs = 0
            self._transmit(time_ns)
        self._syncs += 1

    def _packed(self) -> bytes:
        return self.packing.pack(*[e.value for e in self.entries])

    def _transmit(self, time_ns: int) -> None:
        self._owed = False
        self._send(self.cob_id, self._packed(), time_ns)
        if self.kind >= 254:
            inhibit = self._dictionary.value(self._parameter, 3)
            if inhibit:
                self._inhibit.arm(time_ns + inhibit * _NS_PER_100US)
            if self.event_ms:
                self._event.arm(time_ns + self.event_ms * _NS_PER_MS)

    def _inhibit_over(self, time_ns: int) -> None:
        if self._owed:
            self.trigger(time_ns)


def _nothing() -> None:
    """A PDO that nobody watches changed."""


# --- The PDOs of a node ----------------------------------------------------------------------------------------------
# All PDOs of one node, and the order of things at SYNC. Used by the node for every SYNC and RPDO frame while it is
# operational.


_PDOS = 4


class PdoEngine:
    """RPDO 1-4 and TPDO 1-4, as far as the dictionary has them."""

    def __init__(
        self,
        dictionary: DeviceDictionary,
        timeline: Timeline,
        emergency: Emergency,
        send: Callable[[int, bytes, int], object],
        application: Application,
    ) -> None:
        self._application, self._emergency = application, emergency
        self._overflow = dictionary.entry(Obj301.SYNC_OVERFLOW)
        receive = [n for n in range(_PDOS) if dictionary.has(Obj301.RPDO_PARAMETER + n, 1)]
        self.rpdos = [Rpdo(n, dictionary, emergency, timeline, application.commands_overdue) for n in receive]
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
