"""SDO block transfers of a node, one object for each transfer under way (CiA 301, 7.2.4.3.9 to 7.2.4.3.15).

Used by the SDO server, which hands every frame here while a block transfer runs. With CRC (CRC-16, x16+x12+x5+1).
"""

from __future__ import annotations

import struct
from binascii import crc_hqx
from collections.abc import Callable

from servod.drivers.virtual.dictionary import Dictionary, SdoRefusal
from servod.runtime.fieldbus.cia import Abort

_HEAD = struct.Struct("<BHBI")
_BLOCK_SEGMENTS = 127
_MAX_BYTES = 65536
Send = Callable[[bytes], object]


class BlockDownload:
    """Client to node. The first frame is the initiate request; SdoRefusal ends the transfer."""

    def __init__(self, dictionary: Dictionary, request: bytes, send: Send) -> None:
        command, self._index, self._subindex, size = _HEAD.unpack(request)
        if not dictionary.entry(self._index, self._subindex).writable:
            raise SdoRefusal(Abort.WRITE_OF_READ_ONLY)
        self._dictionary, self._send = dictionary, send
        self._crc = bool(command & 4)
        self._size = size if command & 2 else None
        self._data = b""
        self._sequence = 0
        self._ending = False
        send(_HEAD.pack(0xA4, self._index, self._subindex, _BLOCK_SEGMENTS))

    @property
    def abortable(self) -> bool:
        """Inside a block the byte 0x80 could be a segment only with number 0, which does not exist: always an abort."""
        return True

    def frame(self, data: bytes) -> bool:
        """One frame of the client; True when the transfer is complete."""
        if self._ending:
            return self._end(data)
        number, last = data[0] & 0x7F, bool(data[0] & 0x80)
        if number == 0:
            raise SdoRefusal(Abort.SEQUENCE_NUMBER)
        if number == self._sequence + 1:
            self._sequence = number
            self._data += data[1:8]
            self._ending = last
        if len(self._data) > _MAX_BYTES:
            raise SdoRefusal(Abort.OUT_OF_MEMORY)
        if last or number == _BLOCK_SEGMENTS:
            self._send(bytes((0xA2, self._sequence, _BLOCK_SEGMENTS)).ljust(8, b"\0"))
            self._sequence = 0
        return False

    def _end(self, data: bytes) -> bool:
        if data[0] & 0xE3 != 0xC1:
            raise SdoRefusal(Abort.BAD_COMMAND)
        unused = data[0] >> 2 & 7
        value = self._data[: len(self._data) - unused]
        if self._crc and crc_hqx(value, 0) != int.from_bytes(data[1:3], "little"):
            raise SdoRefusal(Abort.CRC)
        if self._size is not None and self._size != len(value):
            raise SdoRefusal(Abort.LENGTH_MISMATCH)
        self._dictionary.download(self._index, self._subindex, value)
        self._send(b"\xa1".ljust(8, b"\0"))
        return True


class BlockUpload:
    """Node to client."""

    abortable = True

    def __init__(self, dictionary: Dictionary, request: bytes, send: Send) -> None:
        _, index, subindex, parameters = _HEAD.unpack(request)
        self._block = self._block_size(parameters & 0xFF)
        self._value = dictionary.upload(index, subindex)
        self._send = send
        self._position = 0
        self._ending = False
        send(_HEAD.pack(0xC6, index, subindex, len(self._value)))

    @staticmethod
    def _block_size(segments: int) -> int:
        if not 1 <= segments <= _BLOCK_SEGMENTS:
            raise SdoRefusal(Abort.BLOCK_SIZE)
        return segments

    def frame(self, data: bytes) -> bool:
        """One frame of the client (start, acknowledge, end); True when the transfer is complete."""
        command = data[0]
        if self._ending and command == 0xA1:
            return True
        if command == 0xA2 and not self._ending:
            self._acknowledged(data[1], data[2])
        elif command != 0xA3:
            raise SdoRefusal(Abort.BAD_COMMAND)
        if not self._ending:
            self._send_block()
        return False

    def _acknowledged(self, sequence: int, next_block: int) -> None:
        if sequence > self._block:
            raise SdoRefusal(Abort.SEQUENCE_NUMBER)
        self._position = min(self._position + 7 * sequence, len(self._value))
        self._block = self._block_size(next_block)
        if self._position >= len(self._value):
            unused = -len(self._value) % 7 if self._value else 7
            crc = crc_hqx(self._value, 0).to_bytes(2, "little")
            self._send((bytes((0xC1 | unused << 2,)) + crc).ljust(8, b"\0"))
            self._ending = True

    def _send_block(self) -> None:
        """Send one block from the present position; the last segment of the value is marked."""
        left = max((len(self._value) - self._position + 6) // 7, 1)
        count = min(self._block, left)
        for number in range(1, count + 1):
            start = self._position + 7 * (number - 1)
            last = 0x80 if number == left else 0
            self._send(bytes((number | last,)) + self._value[start : start + 7].ljust(7, b"\0"))
