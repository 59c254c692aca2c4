"""A node's object dictionary: values, types, access and ranges from its EDS file, and the abort code of every refusal.

Stands behind the SDO server (upload, download) and the PDO engine (entries). Numbers are plain Python integers, so that
the cycle packs them without conversion; strings and domains are bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from enum import IntEnum
from functools import cache
from pathlib import Path

import canopen
from canopen.objectdictionary import ODVariable, datatypes

from servod.runtime.fieldbus.cia import Abort, Obj301

#: Bits of the integer types of CiA 301 that the EDS files use; a negative sign marks the signed ones.
INTEGER_BITS = {
    datatypes.BOOLEAN: 8,
    datatypes.INTEGER8: -8,
    datatypes.INTEGER16: -16,
    datatypes.INTEGER32: -32,
    datatypes.INTEGER64: -64,
    datatypes.UNSIGNED8: 8,
    datatypes.UNSIGNED16: 16,
    datatypes.UNSIGNED32: 32,
    datatypes.UNSIGNED64: 64,
}
_ABORT_INJECTION = 0x2005
_MAX_STRING, _MAX_DOMAIN = 32, 4096


class SdoRefusal(Exception):
    """An access that is refused; `code` goes to the client as abort code."""

    def __init__(self, code: Abort | int) -> None:
        self.code = int(code)
        super().__init__(f"SDO abort 0x{self.code:08X}")


class Failure(IntEnum):
    """How the transfer of the faulty object fails below the dictionary (0x2006:5)."""

    NONE = 0
    NO_ANSWER = 1
    WRONG_TOGGLE = 2


class FaultyObject:
    """The vendor's object 0x2006: which object misbehaves, and how.

    Sub 1 index and 2 sub-index name it (index 0: none); 3 the abort code of every access, 4 the bits that are wrong
    when it is read, 5 how its transfer fails (Failure). For trying what a master does with a device of that kind.
    """

    def __init__(self, entries: dict[tuple[int, int], Entry]) -> None:
        self._words = [entries[0x2006, subindex] for subindex in range(1, 6)]

    def failure(self, index: int, subindex: int) -> Failure:
        """How a transfer of this object fails."""
        return Failure(self._words[4].value) if self._names(index, subindex) else Failure.NONE

    def refuse(self, index: int, subindex: int) -> None:
        """Raise SdoRefusal when this object has an abort code to answer with."""
        code = self._words[2].value
        if code and self._names(index, subindex):
            raise SdoRefusal(code)

    def spoil(self, entry: Entry) -> bytes:
        """What a client reads of `entry`."""
        content, wrong = entry.encode(), self._words[3].value
        if not wrong or not self._names(entry.index, entry.subindex):
            return content
        mask = wrong.to_bytes(max(4, len(content)), "little")
        return bytes(a ^ b for a, b in zip(content, mask, strict=False))

    def _names(self, index: int, subindex: int) -> bool:
        return (index, subindex) == (self._words[0].value, self._words[1].value)


class Entry:
    """One sub-object. `value` is what stands there; `read` refreshes it before an upload; `check` may refuse a new
    value by raising SdoRefusal; `written` acts on it afterwards; `locked` refuses writing in the present state."""

    __slots__ = (
        "bits",
        "check",
        "default",
        "high",
        "index",
        "locked",
        "low",
        "mappable",
        "name",
        "raw",
        "read",
        "readable",
        "relative",
        "signed",
        "subindex",
        "value",
        "writable",
        "written",
    )

    def __init__(self, variable: ODVariable) -> None:
        bits = INTEGER_BITS.get(variable.data_type or 0, 0)
        self.index: int = variable.index
        self.subindex: int = variable.subindex
        self.name: str = variable.name
        self.bits, self.signed = abs(bits), bits < 0
        self.raw = b""  # strings and domains
        if bits:
            self.default = int(variable.default or 0)
        else:
            self.default = 0
            self.raw = str(variable.default or "").encode("latin-1")
        self.relative: bool = variable.relative
        self.value = self.default
        self.readable, self.writable = variable.readable, variable.writable
        self.mappable: bool = variable.pdo_mappable
        span = 1 << max(self.bits, 1)
        lowest = -span // 2 if self.signed else 0
        self.low: int = lowest if variable.min is None else variable.min
        self.high: int = lowest + span - 1 if variable.max is None else variable.max
        self.read: Callable[[], None] | None = None
        self.check: Callable[[int], None] | None = None
        self.written: Callable[[int], None] | None = None
        self.locked = False

    def encode(self) -> bytes:
        """The value as it travels, least significant byte first."""
        if not self.bits:
            return self.raw
        return self.value.to_bytes(self.bits // 8, "little", signed=self.signed)


class DeviceDictionary:
    """All entries of one node. `write_lock` is set while the drive is enabled: locked entries then refuse."""

    def __init__(self, eds: Path) -> None:
        self._entries = {(e.index, e.subindex): e for e in map(Entry, _variables(eds))}
        self._indices = {index for index, _ in self._entries}
        self._missing: set[tuple[int, int]] = set()
        self.write_lock = False
        self.injected_abort = 0
        self.faulty = FaultyObject(self._entries)

    def __iter__(self) -> Iterator[Entry]:
        return iter(self._entries.values())

    def entry(self, index: int, subindex: int = 0) -> Entry:
        """The entry; raises SdoRefusal when object or sub-index do not exist."""
        found = self._entries.get((index, subindex))
        if found is None:
            raise SdoRefusal(Abort.NO_SUCH_SUBINDEX if index in self._indices else Abort.NO_SUCH_OBJECT)
        return found

    def remove(self, names: list[str]) -> None:
        """Let clients find no such object ("6007") or sub-index ("1400:5"); inside, its default goes on to hold."""
        for name in names:
            index, _, subindex = name.partition(":")
            self._missing |= {
                key for key in self._entries if key[0] == int(index, 16) and subindex in ("", f"{key[1]:X}")
            }

    def has(self, index: int, subindex: int = 0) -> bool:
        """True when the entry exists."""
        return (index, subindex) in self._entries

    def value(self, index: int, subindex: int = 0) -> int:
        """Present value of an integer entry."""
        return self._entries[index, subindex].value

    def set_default(self, index: int, subindex: int, value: int) -> None:
        """This device's own default, instead of the one in the EDS file; also its present value."""
        entry = self._entries[index, subindex]
        entry.default = entry.value = value

    def lock_while_enabled(self, indices: tuple[int, ...]) -> None:
        """Refuse writing these objects while `write_lock` is set."""
        for entry in self:
            entry.locked = entry.locked or entry.index in indices

    def reset(self, first: int, last: int, node_id: int) -> None:
        """Put the EDS defaults back into first..last; `$NODEID` entries follow `node_id`."""
        for entry in self:
            if first <= entry.index <= last and entry.bits:
                entry.value = entry.default + (node_id if entry.relative else 0)

    def upload(self, index: int, subindex: int) -> bytes:
        """Read one entry for a client; raises SdoRefusal."""
        entry = self.entry(index, subindex)
        self._strike(index, subindex)
        if not entry.readable:
            raise SdoRefusal(Abort.READ_OF_WRITE_ONLY)
        if entry.read is not None:
            entry.read()
        return self.faulty.spoil(entry)

    def download(self, index: int, subindex: int, data: bytes) -> None:
        """Write one entry for a client, all checks made; raises SdoRefusal."""
        entry = self.entry(index, subindex)
        self._strike(index, subindex)
        if not entry.writable:
            raise SdoRefusal(Abort.WRITE_OF_READ_ONLY)
        if self.write_lock and entry.locked:
            raise SdoRefusal(Abort.PRESENT_STATE)
        if entry.bits:
            self._download_integer(entry, data)
        else:
            _download_bytes(entry, data)

    def _download_integer(self, entry: Entry, data: bytes) -> None:
        if 8 * len(data) != entry.bits:
            raise SdoRefusal(Abort.LENGTH_MISMATCH)
        value = int.from_bytes(data, "little", signed=entry.signed)
        if value > entry.high:
            raise SdoRefusal(Abort.VALUE_TOO_HIGH)
        if value < entry.low:
            raise SdoRefusal(Abort.VALUE_TOO_LOW)
        if entry.check is not None:
            entry.check(value)
        entry.value = value
        if entry.written is not None:
            entry.written(value)
        if entry.index == _ABORT_INJECTION:
            self.injected_abort = value

    def _strike(self, index: int, subindex: int) -> None:
        """Answer this access with the injected abort code, once; the faulty object's at every access."""
        if (index, subindex) in self._missing:
            whole = all((i, s) in self._missing for i, s in self._entries if i == index)
            raise SdoRefusal(Abort.NO_SUCH_OBJECT if whole else Abort.NO_SUCH_SUBINDEX)
        self.faulty.refuse(index, subindex)
        if self.injected_abort and index != _ABORT_INJECTION:
            code, self.injected_abort = self.injected_abort, 0
            raise SdoRefusal(code)


def _download_bytes(entry: Entry, data: bytes) -> None:
    """Strings have a longest and a shortest length, domains a place of limited size."""
    if entry.name == "User data":
        if len(data) > _MAX_DOMAIN:
            raise SdoRefusal(Abort.OUT_OF_MEMORY)
    elif len(data) > _MAX_STRING:
        raise SdoRefusal(Abort.TOO_LONG)
    elif not data:
        raise SdoRefusal(Abort.TOO_SHORT)
    entry.raw = data


@cache
def _variables(eds: Path) -> tuple[ODVariable, ...]:
    """The variables of an EDS file, which is read once: many stepped worlds are built in one process."""
    source = canopen.import_od(str(eds), 0)
    items = [[item] if isinstance(item, ODVariable) else item.values() for item in source.values()]
    return tuple(variable for group in items for variable in group)


# --- Store and restore -----------------------------------------------------------------------------------------------
# Store and restore of a node's parameters: 0x1010 and 0x1011 (CiA 301, 7.5.2.13 and 7.5.2.14). What is stored survives
# resets of the node, as long as its process lives.


SAVE, LOAD = 0x65766173, 0x64616F6C  # "save", "load"
#: Sub-index of 0x1010 and 0x1011 -> range of objects.
_RANGES = {1: (0x1000, 0x9FFF), 2: (0x1000, 0x1FFF), 3: (0x2000, 0x9FFF)}


class Storage:
    """The node's non-volatile memory, and the entries that fill and empty it."""

    def __init__(self, dictionary: DeviceDictionary) -> None:
        self._dictionary = dictionary
        self._stored: dict[tuple[int, int], int] = {}
        for subindex, (first, last) in _RANGES.items():
            store = dictionary.entry(Obj301.STORE, subindex)
            store.check = self._checker(SAVE, first, last, self._save)
            restore = dictionary.entry(Obj301.RESTORE, subindex)
            restore.check = self._checker(LOAD, first, last, self._forget)
            store.written = restore.written = self._show_capability

    def restore(self, first: int, last: int, node_id: int) -> None:
        """Put stored values, or the defaults, into first..last, as a reset does."""
        self._dictionary.reset(first, last, node_id)
        for (index, subindex), value in self._stored.items():
            if first <= index <= last:
                self._dictionary.entry(index, subindex).value = value

    def _save(self, first: int, last: int) -> None:
        for entry in self._dictionary:
            if first <= entry.index <= last and entry.writable and entry.readable and entry.bits:
                self._stored[entry.index, entry.subindex] = entry.value

    def _forget(self, first: int, last: int) -> None:
        self._stored = {key: value for key, value in self._stored.items() if not first <= key[0] <= last}

    def _show_capability(self, value: int) -> None:
        """Reading 0x1010 and 0x1011 gives what the device can (bit 0: on command), not what was written."""
        for subindex in _RANGES:
            self._dictionary.entry(Obj301.STORE, subindex).value = 1
            self._dictionary.entry(Obj301.RESTORE, subindex).value = 1

    def _checker(self, signature: int, first: int, last: int, act: Callable[[int, int], None]) -> Callable[[int], None]:
        def check(value: int) -> None:
            if value != signature:
                raise SdoRefusal(Abort.CANNOT_STORE)
            act(first, last)

        return check
