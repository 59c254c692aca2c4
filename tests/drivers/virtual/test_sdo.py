"""SDO server of the nodes (CiA 301): every abort code that servod names is reachable; segmented and block transfers."""

from __future__ import annotations

import struct
from binascii import crc_hqx
from collections.abc import Callable

import pytest

from servod.runtime.fieldbus.cia import Abort, Obj402
from tests.drivers.virtual.bench import AMPLIFIER, ENCODER, AbortedError, Bench, abort_code

LOOK = struct.Struct("<BHB")


def wrong_toggle(b: Bench) -> None:
    b.request(AMPLIFIER, LOOK.pack(0x40, 0x1008, 0))
    b.request(AMPLIFIER, b"\x70")


def stalled(b: Bench) -> None:
    b.request(AMPLIFIER, LOOK.pack(0x40, 0x1008, 0))
    b.pass_time(1.5)
    raise AbortedError(int.from_bytes(b.frames(0x581)[-1][4:], "little"))


def bad_crc(b: Bench) -> None:
    b.request(AMPLIFIER, LOOK.pack(0xC6, 0x2004, 0) + (7).to_bytes(4, "little"))
    b.request(AMPLIFIER, b"\x81abcdefg")
    b.request(AMPLIFIER, b"\xc1\x34\x12")


def bad_sequence(b: Bench) -> None:
    b.request(AMPLIFIER, LOOK.pack(0xC6, 0x2004, 0) + (7).to_bytes(4, "little"))
    b.request(AMPLIFIER, b"\x00abcdefg")


def enabled_set_up(b: Bench) -> None:
    b.enabled()
    b.write(AMPLIFIER, Obj402.RATED_TORQUE, 0, 200, 4)


def under_local_control(b: Bench) -> None:
    b.write(AMPLIFIER, 0x2000, 4, 1, 1)
    b.write(AMPLIFIER, Obj402.CONTROL_WORD, 0, 6, 2)


def max_below_min(b: Bench) -> None:
    b.write(AMPLIFIER, 0x607D, 1, 100, 4)
    b.write(AMPLIFIER, 0x607D, 2, 99, 4)


def pdo_too_long(b: Bench) -> None:
    b.write(AMPLIFIER, 0x1A02, 0, 0, 1)
    for number in (1, 2, 3):
        b.write(AMPLIFIER, 0x1A02, number, 0x60640020, 4)
    b.write(AMPLIFIER, 0x1A02, 0, 3, 1)


def same_consumer_twice(b: Bench) -> None:
    b.write(AMPLIFIER, 0x1016, 1, 0x7E0064, 4)
    b.write(AMPLIFIER, 0x1016, 2, 0x7E0064, 4)


NATURAL: dict[Abort, Callable[[Bench], object]] = {
    Abort.TOGGLE_BIT: wrong_toggle,
    Abort.TIME_OUT: stalled,
    Abort.BAD_COMMAND: lambda b: b.request(AMPLIFIER, b"\xe0"),
    Abort.BLOCK_SIZE: lambda b: b.request(AMPLIFIER, LOOK.pack(0xA4, 0x1008, 0) + b"\x80"),
    Abort.SEQUENCE_NUMBER: bad_sequence,
    Abort.CRC: bad_crc,
    Abort.OUT_OF_MEMORY: lambda b: b.write_segments(AMPLIFIER, 0x2004, 0, bytes(4097)),
    Abort.READ_OF_WRITE_ONLY: lambda b: b.read(AMPLIFIER, 0x2003),
    Abort.WRITE_OF_READ_ONLY: lambda b: b.write(AMPLIFIER, 0x6041, 0, 0, 2),
    Abort.NO_SUCH_OBJECT: lambda b: b.read(AMPLIFIER, 0x5FFF),
    Abort.NOT_MAPPABLE: lambda b: b.write(AMPLIFIER, 0x1A02, 1, 0x60650020, 4),
    Abort.PDO_TOO_LONG: pdo_too_long,
    Abort.INCOMPATIBLE_PARAMETER: same_consumer_twice,
    Abort.LENGTH_MISMATCH: lambda b: b.write(AMPLIFIER, 0x6040, 0, 0, 4),
    Abort.TOO_LONG: lambda b: b.write_segments(AMPLIFIER, 0x2002, 0, b"x" * 33),
    Abort.TOO_SHORT: lambda b: b.write_segments(AMPLIFIER, 0x2002, 0, b""),
    Abort.NO_SUCH_SUBINDEX: lambda b: b.read(AMPLIFIER, 0x1018, 5),
    Abort.VALUE_RANGE: lambda b: b.write(AMPLIFIER, 0x6060, 0, 3, 1),
    Abort.VALUE_TOO_HIGH: lambda b: b.write(AMPLIFIER, 0x605A, 0, 9, 2),
    Abort.VALUE_TOO_LOW: lambda b: b.write(AMPLIFIER, 0x605A, 0, -1, 2),
    Abort.MAX_BELOW_MIN: max_below_min,
    Abort.CANNOT_STORE: lambda b: b.write(AMPLIFIER, 0x1010, 1, 1, 4),
    Abort.LOCAL_CONTROL: under_local_control,
    Abort.PRESENT_STATE: enabled_set_up,
    Abort.NO_DATA: lambda b: b.read(AMPLIFIER, 0x1003, 1),
}


@pytest.mark.parametrize("code", NATURAL)
def test_abort_codes_with_a_cause(bench: Bench, code: Abort) -> None:
    assert abort_code(lambda: NATURAL[code](bench)) is code
    assert bench.read(AMPLIFIER, 0x1000) == 0x00020192  # the server is ready for the next request


@pytest.mark.parametrize("code", [code for code in Abort if code not in NATURAL])
def test_abort_codes_on_demand(bench: Bench, code: Abort) -> None:
    bench.write(ENCODER, 0x2005, 0, code, 4)
    assert abort_code(lambda: bench.read(ENCODER, 0x6004)) is code
    assert abort_code(lambda: bench.read(ENCODER, 0x6004)) == 0


def test_the_server_never_answers_an_abort(bench: Bench) -> None:
    with pytest.raises(TimeoutError):
        bench.request(AMPLIFIER, struct.pack("<BHBI", 0x80, 0x1000, 0, Abort.TIME_OUT))


@pytest.mark.parametrize("text", [b"a", b"abcd", b"seven 7", b"eight 88", b"thirty-two bytes of axis label.."])
def test_strings_in_segments(bench: Bench, text: bytes) -> None:
    bench.write_segments(AMPLIFIER, 0x2002, 0, text)
    assert bench.upload(AMPLIFIER, 0x2002) == text


@pytest.mark.parametrize("size", [1, 7, 8, 889, 890, 4096])
def test_block_transfer_both_ways(bench: Bench, size: int) -> None:
    value = bytes(n * 7 % 251 for n in range(size))
    block_download(bench, value)
    assert bench.upload(AMPLIFIER, 0x2004) == value
    assert block_upload(bench, 0x2004) == value


def block_download(bench: Bench, value: bytes) -> None:
    bench.request(AMPLIFIER, LOOK.pack(0xC6, 0x2004, 0) + len(value).to_bytes(4, "little"))
    segments = [value[i : i + 7] for i in range(0, len(value), 7)]
    for start in range(0, len(segments), 127):
        block = segments[start : start + 127]
        for number, segment in enumerate(block, start=1):
            last = start + number == len(segments)
            data = (bytes((number | (0x80 if last else 0),)) + segment).ljust(8, b"\0")
            if number == len(block):
                assert bench.request(AMPLIFIER, data)[1] == number
            else:
                bench.bus.send(0x601, data)
                bench.pass_time(0.0002)
    unused = -len(value) % 7
    bench.request(AMPLIFIER, bytes((0xC1 | unused << 2,)) + crc_hqx(value, 0).to_bytes(2, "little"))


def block_upload(bench: Bench, index: int) -> bytes:
    answer = bench.request(AMPLIFIER, LOOK.pack(0xA4, index, 0) + b"\x7f")
    size = int.from_bytes(answer[4:8], "little")
    bench.bus.send(0x601, b"\xa3".ljust(8, b"\0"))
    value, number = b"", 0
    while len(value) < size:
        frame = bench.bus.receive(0.01)
        assert frame is not None
        number = frame.data[0] & 0x7F
        value += frame.data[1:]
        if number == 127 or frame.data[0] & 0x80:
            bench.bus.send(0x601, bytes((0xA2, number, 127)).ljust(8, b"\0"))
    frame = bench.bus.receive(0.01)
    assert frame is not None
    value = value[:size]
    assert int.from_bytes(frame.data[1:3], "little") == crc_hqx(value, 0)
    bench.bus.send(0x601, b"\xa1".ljust(8, b"\0"))
    return value
