"""SDO server of a node: expedited and segmented transfers, and the way into block transfers (CiA 301, 7.2.4).

Stands between the bus and the dictionary. One client at a time; a transfer that stalls is aborted with 05040000;
a client's abort ends a transfer without an answer.
"""

from __future__ import annotations

import struct
from binascii import crc_hqx
from collections.abc import Callable
from dataclasses import dataclass

from servod.common.units import NS_PER_S
from servod.drivers.virtual.dictionary import DeviceDictionary, Failure, SdoRefusal
from servod.drivers.virtual.timeline import Timeline
from servod.runtime.fieldbus.cia import Abort

# --- Block transfers -------------------------------------------------------------------------------------------------
# SDO block transfers of a node, one object for each transfer under way (CiA 301, 7.2.4.3.9 to 7.2.4.3.15). Used by the
# SDO server, which hands every frame here while a block transfer runs. With CRC (CRC-16, x16+x12+x5+1).


_SDO_BLOCK_HEAD = struct.Struct("<BHBI")
_BLOCK_SEGMENTS = 127
_MAX_BYTES = 65536
Send = Callable[[bytes], object]


class BlockDownload:
    """Client to node. The first frame is the initiate request; SdoRefusal ends the transfer."""

    def __init__(self, dictionary: DeviceDictionary, request: bytes, send: Send) -> None:
        command, self._index, self._subindex, size = _SDO_BLOCK_HEAD.unpack(request)
        if not dictionary.entry(self._index, self._subindex).writable:
            raise SdoRefusal(Abort.WRITE_OF_READ_ONLY)
        self._dictionary, self._send = dictionary, send
        self._crc = bool(command & 4)
        self._size = size if command & 2 else None
        self._data = b""
        self._sequence = 0
        self._ending = False
        send(_SDO_BLOCK_HEAD.pack(0xA4, self._index, self._subindex, _BLOCK_SEGMENTS))

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

    def __init__(self, dictionary: DeviceDictionary, request: bytes, send: Send) -> None:
        _, index, subindex, parameters = _SDO_BLOCK_HEAD.unpack(request)
        self._block = self._block_size(parameters & 0xFF)
        self._value = dictionary.upload(index, subindex)
        self._send = send
        self._position = 0
        self._ending = False
        send(_SDO_BLOCK_HEAD.pack(0xC6, index, subindex, len(self._value)))

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


_HEAD = struct.Struct("<BHB4s")
_ABORT = struct.Struct("<BHBI")
#: A transfer that gets no next request for so long is aborted.
STALL_NS = 1 * NS_PER_S


@dataclass(slots=True)
class _Segments:
    """A segmented transfer under way; `data` is what is left to send, or what came."""

    index: int
    subindex: int
    upload: bool
    data: bytes
    size: int | None = None
    toggle: int = 0
    wrong_toggle: int = 0  # turned round in the answers of a faulty object


class SdoServer:
    """Answers requests on 0x600+id through `send`, which puts 8 bytes on 0x580+id."""

    def __init__(self, dictionary: DeviceDictionary, send: Callable[[bytes], object], timeline: Timeline) -> None:
        self._dictionary, self._send = dictionary, send
        self._segments: _Segments | None = None
        self._block: BlockDownload | BlockUpload | None = None
        self._stall = timeline.timer(self._stalled)
        self._object = (0, 0)

    def reset(self) -> None:
        """Forget a transfer under way."""
        self._segments = self._block = None
        self._stall.cancel()

    def request(self, data: bytes, time_ns: int) -> None:
        """One request frame of the client."""
        if len(data) != 8:
            return
        if self._faulty(data) is Failure.NO_ANSWER:
            return
        try:
            self._serve(data)
        except SdoRefusal as refusal:
            self._abort(refusal.code)
        if self._segments is None and self._block is None:
            self._stall.cancel()
        else:
            self._stall.arm(time_ns + STALL_NS)

    def _faulty(self, data: bytes) -> Failure:
        """How the transfer that this request begins fails."""
        _, index, subindex, _ = _HEAD.unpack(data)
        return self._dictionary.faulty.failure(index, subindex)

    def _serve(self, data: bytes) -> None:
        if self._block is not None and self._serve_block(data):
            return
        command = data[0] >> 5
        if command == 4:
            self.reset()
        elif command == 1:
            self._initiate_download(data)
        elif command == 2:
            self._initiate_upload(data)
        elif command == 0:
            self._download_segment(data)
        elif command == 3:
            self._upload_segment(data)
        elif command == 6 and not data[0] & 1:
            self._name(data)
            self._block = BlockDownload(self._dictionary, data, self._send)
        elif command == 5 and not data[0] & 3:
            self._name(data)
            self._block = BlockUpload(self._dictionary, data, self._send)
        else:
            raise SdoRefusal(Abort.BAD_COMMAND)

    def _serve_block(self, data: bytes) -> bool:
        """Give the frame to the block transfer; False when it is an abort, which is served as usual."""
        assert self._block is not None
        if data[0] == 0x80 and self._block.abortable:
            return False
        if self._block.frame(data):
            self._block = None
        return True

    def _name(self, data: bytes) -> tuple[int, int]:
        """Remember which object this transfer is about; a new transfer ends the one before."""
        self._segments = None
        _, index, subindex, _ = _HEAD.unpack(data)
        self._object = (index, subindex)
        return self._object

    def _initiate_download(self, data: bytes) -> None:
        index, subindex = self._name(data)
        if data[0] & 2:
            length = 4 - (data[0] >> 2 & 3) if data[0] & 1 else 4
            self._dictionary.download(index, subindex, data[4 : 4 + length])
        else:
            if not self._dictionary.entry(index, subindex).writable:
                raise SdoRefusal(Abort.WRITE_OF_READ_ONLY)
            size = int.from_bytes(data[4:8], "little") if data[0] & 1 else None
            self._segments = _Segments(index, subindex, upload=False, data=b"", size=size)
        self._send(_HEAD.pack(0x60, index, subindex, b""))

    def _initiate_upload(self, data: bytes) -> None:
        index, subindex = self._name(data)
        value = self._dictionary.upload(index, subindex)
        wrong_toggle = 0x10 if self._faulty(data) is Failure.WRONG_TOGGLE else 0
        if 0 < len(value) <= 4 and not wrong_toggle:
            self._send(_HEAD.pack(0x43 | (4 - len(value)) << 2, index, subindex, value))
            return
        self._segments = _Segments(index, subindex, upload=True, data=value, wrong_toggle=wrong_toggle)
        self._send(_HEAD.pack(0x41, index, subindex, len(value).to_bytes(4, "little")))

    def _expect(self, upload: bool, toggle: int) -> _Segments:
        transfer = self._segments
        if transfer is None or transfer.upload is not upload:
            raise SdoRefusal(Abort.BAD_COMMAND)
        if transfer.toggle != toggle:
            raise SdoRefusal(Abort.TOGGLE_BIT)
        return transfer

    def _download_segment(self, data: bytes) -> None:
        transfer = self._expect(False, data[0] & 0x10)
        transfer.data += data[1 : 8 - (data[0] >> 1 & 7)]
        last = data[0] & 1
        if len(transfer.data) > 65536:
            raise SdoRefusal(Abort.OUT_OF_MEMORY)
        if last:
            if transfer.size is not None and transfer.size != len(transfer.data):
                raise SdoRefusal(Abort.LENGTH_MISMATCH)
            self._dictionary.download(transfer.index, transfer.subindex, transfer.data)
            self._segments = None
        self._send(bytes((0x20 | transfer.toggle,)).ljust(8, b"\0"))
        transfer.toggle ^= 0x10

    def _upload_segment(self, data: bytes) -> None:
        transfer = self._expect(True, data[0] & 0x10)
        chunk, transfer.data = transfer.data[:7], transfer.data[7:]
        head = transfer.toggle ^ transfer.wrong_toggle | (7 - len(chunk)) << 1 | (0 if transfer.data else 1)
        self._send(bytes((head,)) + chunk.ljust(7, b"\0"))
        transfer.toggle ^= 0x10
        if not transfer.data:
            self._segments = None

    def _stalled(self, time_ns: int) -> None:
        self._abort(Abort.TIME_OUT)

    def _abort(self, code: int) -> None:
        self._segments = self._block = None
        self._send(_ABORT.pack(0x80, *self._object, code))
