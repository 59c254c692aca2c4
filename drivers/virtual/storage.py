"""Store and restore of a node's parameters: 0x1010 and 0x1011 (CiA 301, 7.5.2.13 and 7.5.2.14).

Beside the node's services. What is stored survives resets of the node, as long as its process lives.
"""

from __future__ import annotations

from collections.abc import Callable

from servod.drivers.virtual.dictionary import Dictionary, SdoRefusal
from servod.runtime.fieldbus.cia import Abort, Obj301

SAVE, LOAD = 0x65766173, 0x64616F6C  # "save", "load"
#: Sub-index of 0x1010 and 0x1011 -> range of objects.
_RANGES = {1: (0x1000, 0x9FFF), 2: (0x1000, 0x1FFF), 3: (0x2000, 0x9FFF)}


class Storage:
    """The node's non-volatile memory, and the entries that fill and empty it."""

    def __init__(self, dictionary: Dictionary) -> None:
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
