"""What may be written to PDO parameters and mappings, and when (CiA 301, 7.5.2.35 to 7.5.2.38).

Hooks into the dictionary's entries 0x1400 to 0x1BFF. The order is forced: PDO not valid, sub 0 of the mapping to zero,
entries, sub 0, PDO valid; anything else is refused with the abort code that the standard or the field uses.
"""

from __future__ import annotations

from collections.abc import Callable

from servod.drivers.virtual.dictionary import Dictionary, Entry, SdoRefusal
from servod.runtime.fieldbus.cia import PDO_NOT_VALID, Abort

_MAX_ENTRIES, _MAX_BITS = 8, 64
#: Identifiers that no PDO may use (CiA 301, table of restricted COB-IDs).
_RESTRICTED = (range(0x000, 0x080), range(0x101, 0x181), range(0x581, 0x600), range(0x601, 0x680), range(0x6E0, 0x800))


class PdoRules:
    """The rules of one PDO: `parameter` is 0x1400.. or 0x1800.., `mapping` 0x1600.. or 0x1A00...
    `changed()` is called after each accepted write."""

    def __init__(self, dictionary: Dictionary, parameter: int, mapping: int, changed: Callable[[], None]) -> None:
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
