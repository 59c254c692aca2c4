"""PDOs of the nodes (CiA 301, 0x1400 to 0x1BFF): the remap sequence, transmission types, lengths, deadlines."""

from __future__ import annotations

import pytest

from servod.runtime.fieldbus.bus import CAN_RTR_FLAG
from servod.runtime.fieldbus.cia import Emcy, Obj402
from tests.drivers.virtual.bench import AMPLIFIER, ENCODER, Bench, abort_code

OFF = 0x80000000
RPDO1, TPDO1, TPDO3 = 0x201, 0x181, 0x381


def remap(bench: Bench, parameter: int, mapping: int, cob_id: int, kind: int, words: list[int]) -> None:
    bench.write(AMPLIFIER, parameter, 1, OFF | cob_id, 4)
    bench.write(AMPLIFIER, parameter, 2, kind, 1)
    bench.write(AMPLIFIER, mapping, 0, 0, 1)
    for number, word in enumerate(words, start=1):
        bench.write(AMPLIFIER, mapping, number, word, 4)
    bench.write(AMPLIFIER, mapping, 0, len(words), 1)
    bench.write(AMPLIFIER, parameter, 1, cob_id, 4)


def test_the_right_sequence_remaps(bench: Bench) -> None:
    remap(bench, 0x1802, 0x1A02, TPDO3, 1, [0x60770010, 0x60640020])
    bench.operational()
    bench.cycle(cycles=3)
    assert [len(data) for data in bench.frames(TPDO3)] == [6, 6, 6]


def test_every_wrong_order_is_refused(bench: Bench) -> None:
    def refused(index: int, subindex: int, value: int, size: int) -> int:
        return abort_code(lambda: bench.write(AMPLIFIER, index, subindex, value, size))

    assert refused(0x1A00, 0, 0, 1) == 0x08000022  # still valid
    assert refused(0x1A00, 1, 0x60770010, 4) == 0x08000022
    assert refused(0x1800, 1, 0x1FF, 4) == 0x08000022  # another id while valid
    assert refused(0x1800, 3, 10, 2) == 0x08000022  # inhibit time while valid
    bench.write(AMPLIFIER, 0x1800, 1, OFF | TPDO1, 4)
    assert refused(0x1A00, 1, 0x60770010, 4) == 0x08000022  # sub 0 is not zero
    bench.write(AMPLIFIER, 0x1A00, 0, 0, 1)
    assert refused(0x1A00, 1, 0x60770020, 4) == 0x06040041  # wrong length
    assert refused(0x1A00, 1, 0x60650020, 4) == 0x06040041  # not mappable
    assert refused(0x1A00, 1, 0x5FFF0010, 4) == 0x06020000
    assert refused(0x1600, 0, 0, 1) == 0x08000022
    for number in (1, 2, 3):
        bench.write(AMPLIFIER, 0x1A00, number, 0x60640020, 4)
    assert refused(0x1A00, 0, 3, 1) == 0x06040042  # 96 bits
    assert refused(0x1A00, 0, 9, 1) == 0x06090031
    assert refused(0x1800, 2, 245, 1) == 0x06090030  # reserved type
    assert refused(0x1400, 2, 252, 1) == 0x06090030
    assert refused(0x1800, 1, 0x601, 4) == 0x06090030  # restricted id


def test_a_read_only_object_cannot_be_received(bench: Bench) -> None:
    bench.write(AMPLIFIER, 0x1400, 1, OFF | RPDO1, 4)
    bench.write(AMPLIFIER, 0x1600, 0, 0, 1)
    assert abort_code(lambda: bench.write(AMPLIFIER, 0x1600, 1, 0x60410010, 4)) == 0x06040041


@pytest.mark.parametrize(("kind", "frames"), [(1, 12), (2, 6), (3, 4), (240, 1)])
def test_every_nth_sync(bench: Bench, kind: int, frames: int) -> None:
    remap(bench, 0x1802, 0x1A02, TPDO3, kind, [0x60770010])
    bench.operational()
    bench.cycle(cycles=12)
    assert len(bench.frames(TPDO3)) == frames


def test_acyclic_synchronous_sends_only_after_a_change(bench: Bench) -> None:
    remap(bench, 0x1802, 0x1A02, TPDO3, 0, [0x60410010])
    bench.operational()
    bench.cycle(0x00, cycles=10)
    before = len(bench.frames(TPDO3))
    bench.cycle(0x06, cycles=10)
    bench.cycle(0x06, cycles=10)
    assert len(bench.frames(TPDO3)) == before + 1


def test_event_timer_and_change(bench: Bench) -> None:
    bench.operational()
    bench.heard.clear()
    bench.pass_time(1.0)
    assert len(bench.frames(0x281)) in (9, 10, 11)
    bench.heard.clear()
    bench.write(AMPLIFIER, Obj402.MODE, 0, 9, 1)
    bench.pass_time(0.01)
    assert bench.frames(0x281)[0][0] == 9


@pytest.mark.parametrize("kind", [252, 253])
def test_remote_request(bench: Bench, kind: int) -> None:
    remap(bench, 0x1802, 0x1A02, TPDO3, kind, [0x60410010])
    bench.operational()
    bench.cycle(cycles=3)
    assert bench.frames(TPDO3) == []
    bench.bus.send(TPDO3 | CAN_RTR_FLAG, b"")
    bench.pass_time(0.001)
    assert len(bench.frames(TPDO3)) == 1


def test_event_driven_rpdo_acts_without_sync(bench: Bench) -> None:
    bench.write(AMPLIFIER, 0x1400, 2, 255, 1)
    bench.operational()
    bench.bus.send(RPDO1, b"\x06\x00\x00\x00")
    bench.pass_time(0.001)
    assert bench.read(AMPLIFIER, Obj402.STATUS_WORD) & 0x6F == 0x21


@pytest.mark.parametrize(
    ("data", "code"), [(b"\x06\x00\x00", Emcy.PDO_LENGTH), (b"\x06" + b"\0" * 4, Emcy.PDO_TOO_LONG)]
)
def test_wrong_lengths_are_emergencies(bench: Bench, data: bytes, code: int) -> None:
    bench.operational()
    bench.bus.send(RPDO1, data)
    bench.cycle(cycles=2)
    assert bench.frames(0x081)[0][:2] == code.to_bytes(2, "little")
    assert bool(bench.read(AMPLIFIER, Obj402.CONTROL_WORD)) is (code == Emcy.PDO_TOO_LONG)  # a short one is ignored
    bench.cycle(0x06, cycles=2)
    bench.bus.send(RPDO1, data)
    bench.cycle(cycles=2)
    told = [frame[:2] for frame in bench.frames(0x081)]
    assert told == [code.to_bytes(2, "little"), b"\0\0", code.to_bytes(2, "little")]  # a right one takes it back


def test_a_missing_rpdo_is_an_emergency_and_its_return_clears_it(bench: Bench) -> None:
    bench.write(AMPLIFIER, 0x1400, 5, 20, 2)
    bench.operational()
    bench.cycle(0x06, cycles=50)
    assert bench.frames(0x081) == []
    bench.cycle(cycles=15)
    assert bench.frames(0x081) == []
    bench.cycle(cycles=10)
    assert [data[:2] for data in bench.frames(0x081)] == [b"\x50\x82"]
    bench.cycle(0x06)
    assert [data[:2] for data in bench.frames(0x081)] == [b"\x50\x82", b"\0\0"]


def test_a_value_out_of_range_in_an_rpdo_changes_nothing(bench: Bench) -> None:
    remap(bench, 0x1401, 0x1601, 0x301, 255, [0x60600008])
    bench.operational()
    bench.bus.send(0x301, b"\x7f")
    bench.pass_time(0.001)
    assert bench.read(AMPLIFIER, Obj402.MODE) == 10


def test_sync_counter_and_start_value(bench: Bench) -> None:
    bench.write(ENCODER, 0x1019, 0, 4, 1)
    bench.write(ENCODER, 0x1801, 1, OFF | 0x282, 4)
    bench.write(ENCODER, 0x1801, 6, 3, 1)
    bench.write(ENCODER, 0x1801, 2, 4, 1)
    bench.write(ENCODER, 0x1801, 1, 0x282, 4)
    bench.nmt(1, ENCODER)
    heard = []
    for counter in (1, 2, 3, 4, 1, 2, 3):
        bench.heard.clear()
        bench.bus.send(0x80, bytes((counter,)))
        bench.pass_time(0.001)
        heard.append(len(bench.frames(0x282)))
    assert heard == [0, 0, 1, 0, 0, 0, 1]
    bench.bus.send(0x80, b"")
    bench.pass_time(0.001)
    assert bench.frames(0x082)[0][:2] == b"\x40\x82"


@pytest.mark.parametrize(("value", "code"), [(1, 0x06090030), (241, 0x06090031)])
def test_a_sync_counter_that_cannot_be_is_refused(bench: Bench, value: int, code: int) -> None:
    assert abort_code(lambda: bench.write(AMPLIFIER, 0x1019, 0, value, 1)) == code
    assert bench.read(AMPLIFIER, 0x1019) == 0
