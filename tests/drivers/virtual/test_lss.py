"""LSS slave: selecting, configuring, identifying and finding nodes (CiA 305)."""

from __future__ import annotations

import struct

from servod.runtime.fieldbus.cia import NmtCommand
from tests.drivers.virtual.bench import AMPLIFIER, Bench

IDENTITY = (0x5EBD, 0x402, 0x10000, 1)


def ask(bench: Bench, command: int, *numbers: int) -> list[bytes]:
    bench.heard.clear()
    arguments = b"".join(n.to_bytes(4, "little") for n in numbers)
    bench.bus.send(0x7E5, bytes((command,)) + arguments.ljust(7, b"\0"))
    bench.pass_time(0.002)
    return bench.frames(0x7E4)


def select(bench: Bench) -> None:
    answers = [ask(bench, 0x40 + part, number) for part, number in enumerate(IDENTITY)]
    assert [len(a) for a in answers] == [0, 0, 0, 1]
    assert answers[3][0][0] == 0x44


def test_select_and_inquire(bench: Bench) -> None:
    select(bench)
    assert ask(bench, 0x5E)[0][:2] == bytes((0x5E, AMPLIFIER))
    assert ask(bench, 0x5A)[0][1:5] == (0x5EBD).to_bytes(4, "little")
    assert ask(bench, 0x04, 0) == []
    assert ask(bench, 0x5E) == []


def test_a_new_node_id_acts_at_reset_of_communication(bench: Bench) -> None:
    select(bench)
    assert ask(bench, 0x11, 200)[0][1] == 1
    assert ask(bench, 0x11, 23)[0][1] == 0
    bench.nmt(NmtCommand.RESET_COMMUNICATION, AMPLIFIER)
    assert bench.frames(0x717) == [b"\0"]
    assert bench.read(23, 0x1000) == 0x00020192
    assert bench.read(23, 0x1800, 1) == 0x180 + 23


def test_identify_by_range(bench: Bench) -> None:
    def identify(serial_low: int, serial_high: int) -> list[bytes]:
        numbers = (0x5EBD, 0x402, 0, 0xFFFFFFFF, serial_low, serial_high)
        return [frame for part, n in enumerate(numbers) for frame in ask(bench, 0x46 + part, n)]

    assert len(identify(0, 5)) == 1
    assert identify(2, 5) == []


def test_fast_scan_finds_only_unconfigured_nodes(bench: Bench) -> None:
    def scan(number: int, bit: int, sub: int, next_sub: int) -> bool:
        bench.heard.clear()
        bench.bus.send(0x7E5, struct.pack("<BIBBB", 0x51, number, bit, sub, next_sub))
        bench.pass_time(0.002)
        return bool(bench.frames(0x7E4))

    assert not scan(0, 0x80, 0, 0)
    select(bench)
    ask(bench, 0x11, 0xFF)
    bench.nmt(NmtCommand.RESET_COMMUNICATION, AMPLIFIER)
    ask(bench, 0x04, 0)
    assert ask(bench, 0x4C)[0][0] == 0x50
    assert scan(0, 0x80, 0, 0)
    found = []
    for sub in range(4):
        number = 0
        for bit in range(31, -1, -1):
            if not scan(number, bit, sub, sub):
                number |= 1 << bit
        assert scan(number, 0, sub, (sub + 1) % 4)
        found.append(number)
    assert tuple(found) == IDENTITY
    assert ask(bench, 0x5E)[0][1] == 0xFF  # it is selected now
