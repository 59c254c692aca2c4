"""Small files that unpack to a recording of gigabytes: what fits a thousand times into a packed file."""

from __future__ import annotations

import gzip
import struct
import zlib

_BLOCK_BYTES = 6 * 1024 * 1024
#: Three hundred megabytes of text, and as many of MAT file, unpacked; the numbers in them take eight times as much.
_BLOCKS = 50
_INT8, _INT32, _UINT8, _UINT32, _MATRIX, _COMPRESSED = 1, 5, 2, 6, 14, 15
_INT8_ARRAY = 8


def csv_bomb() -> bytes:
    """A hundred and fifty million cells; gzip files stand one behind the other as one."""
    block = gzip.compress(b"0,0,0\n" * (_BLOCK_BYTES // 6), mtime=0)
    return gzip.compress(b"t_s,torque_nm,position_rad\n", mtime=0) + block * _BLOCKS


def mat_bomb() -> bytes:
    """Three vectors of a hundred million numbers each, one byte long."""
    head = b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<H", 0x0100) + b"IM"
    packed = [_packed_zeros(name) for name in (b"t_s", b"torque_nm", b"position_rad")]
    return head + b"".join(struct.pack("<II", _COMPRESSED, len(one)) + one for one in packed)


def _packed_zeros(name: bytes) -> bytes:
    """A packed vector; its blocks are packed alike, and the checksum at their end is left out."""
    count = _BLOCK_BYTES * _BLOCKS // 3
    parts = [(_UINT32, struct.pack("<II", _INT8_ARRAY, 0)), (_INT32, struct.pack("<ii", count, 1)), (_INT8, name)]
    inside = b"".join(
        struct.pack("<II", kind, len(data)) + data.ljust(-(-len(data) // 8) * 8, b"\0") for kind, data in parts
    )
    inside += struct.pack("<II", _UINT8, count)
    packer = zlib.compressobj()
    begin = packer.compress(struct.pack("<II", _MATRIX, len(inside) + count) + inside) + packer.flush(zlib.Z_FULL_FLUSH)
    block = packer.compress(bytes(_BLOCK_BYTES // 3)) + packer.flush(zlib.Z_FULL_FLUSH)
    return begin + block * _BLOCKS
