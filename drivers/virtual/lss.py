"""LSS slave of a node: select, configure node id, inquire, identify, fast scan (CiA 305).

Stands beside the other services; hears 0x7E5, answers on 0x7E4. A new node id acts at the next reset of communication.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from enum import IntEnum

_FAST_SCAN = struct.Struct("<BIBBB")
_UNCONFIGURED = 0xFF


class _Command(IntEnum):
    SWITCH_GLOBAL = 0x04
    CONFIGURE_NODE_ID = 0x11
    CONFIGURE_BIT_TIMING = 0x13
    STORE = 0x17
    SELECT_VENDOR = 0x40
    SELECT_SERIAL = 0x43
    SELECTED = 0x44
    IDENTIFY_FIRST = 0x46
    IDENTIFY_LAST = 0x4B
    IDENTIFIED = 0x4F
    IDENTIFY_UNCONFIGURED = 0x4C
    UNCONFIGURED = 0x50
    FAST_SCAN = 0x51
    INQUIRE_VENDOR = 0x5A
    INQUIRE_SERIAL = 0x5D
    INQUIRE_NODE_ID = 0x5E


class LssSlave:
    """`identity` is the four numbers of 0x1018, `send(data)` answers; `pending_node_id` is what the next reset of
    communication shall use."""

    def __init__(self, identity: tuple[int, int, int, int], node_id: int, send: Callable[[bytes], object]) -> None:
        self._identity, self._send = identity, send
        self.node_id = self.pending_node_id = node_id
        self._configuring = False
        self._selected = 0
        self._identified: list[int] = []
        self._scan_position = 0

    def request(self, data: bytes) -> None:
        """One frame of the LSS master."""
        if len(data) != 8:
            return
        command, value = data[0], int.from_bytes(data[1:5], "little")
        if command == _Command.SWITCH_GLOBAL:
            self._configuring = data[1] == 1
        elif _Command.SELECT_VENDOR <= command <= _Command.SELECT_SERIAL:
            self._select(command - _Command.SELECT_VENDOR, value)
        elif _Command.IDENTIFY_FIRST <= command <= _Command.IDENTIFY_LAST:
            self._identify(command - _Command.IDENTIFY_FIRST, value)
        elif command == _Command.IDENTIFY_UNCONFIGURED:
            if self.node_id == _UNCONFIGURED:
                self._answer(_Command.UNCONFIGURED)
        elif command == _Command.FAST_SCAN:
            self._fast_scan(data)
        elif self._configuring:
            self._configure(command, data)

    def _answer(self, command: int, value: int = 0) -> None:
        self._send(struct.pack("<BI3x", command, value))

    def _select(self, part: int, value: int) -> None:
        """Selective switch: the four numbers in order; the last match selects this node."""
        matches = part == self._selected and self._identity[part] == value
        self._selected = part + 1 if matches else 0
        if self._selected == 4:
            self._selected, self._configuring = 0, True
            self._answer(_Command.SELECTED)

    def _identify(self, part: int, value: int) -> None:
        """Identify remote slave: vendor, product, revision from-to, serial from-to."""
        self._identified = [*self._identified, value] if part == len(self._identified) else []
        if len(self._identified) < 6:
            return
        vendor, product, *bounds = self._identified
        self._identified = []
        own_vendor, own_product, revision, serial = self._identity
        named = (vendor, product) == (own_vendor, own_product)
        if named and bounds[0] <= revision <= bounds[1] and bounds[2] <= serial <= bounds[3]:
            self._answer(_Command.IDENTIFIED)

    def _configure(self, command: int, data: bytes) -> None:
        if command == _Command.CONFIGURE_NODE_ID:
            allowed = 1 <= data[1] <= 127 or data[1] == _UNCONFIGURED
            if allowed:
                self.pending_node_id = data[1]
            self._answer(command, 0 if allowed else 1)
        elif command == _Command.CONFIGURE_BIT_TIMING:
            self._answer(command, 1)  # the bit rate belongs to the virtual bus
        elif command == _Command.STORE:
            self._answer(command)
        elif _Command.INQUIRE_VENDOR <= command <= _Command.INQUIRE_SERIAL:
            self._answer(command, self._identity[command - _Command.INQUIRE_VENDOR])
        elif command == _Command.INQUIRE_NODE_ID:
            self._answer(command, self.node_id)

    def _fast_scan(self, data: bytes) -> None:
        """Bitwise search for unconfigured nodes (CiA 305): answer when the bits above `bit` agree."""
        _, id_number, bit, sub, next_sub = _FAST_SCAN.unpack(data)
        if self.node_id != _UNCONFIGURED or self._configuring:
            return
        if bit == 0x80:
            self._scan_position = 0
            self._answer(_Command.IDENTIFIED)
        elif sub == self._scan_position and bit < 32 and sub < 4:
            mask = 0xFFFFFFFF << bit & 0xFFFFFFFF
            if (self._identity[sub] ^ id_number) & mask:
                return
            self._scan_position = next_sub
            if bit == 0 and next_sub < sub:
                self._configuring = True
            self._answer(_Command.IDENTIFIED)
