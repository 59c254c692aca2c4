"""CANopenNode's SDO client, NMT master, heartbeat consumer and LSS master against the virtual axis."""

from __future__ import annotations

import base64
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from servod import drivers
from servod.runtime.fieldbus.cia import Abort
from tests.foreign.canopennode import Gateway, party
from tests.foreign.daemon import virtual_axis

EDS = Path(drivers.__file__).parent / "eds"
AMPLIFIER, ENCODER, FOREIGN = 1, 2, 100
HEARTBEAT = 'Remote node ID = 0x{:02X} (index = {}): NMT state changed to: "{}"'
EMERGENCY = "Emergency message from node 0x{:02X}: errorCode=0x{:04X}"
DATA = base64.b64encode(bytes(range(256)) * 7 + b"end").decode()
LABEL = '"the third joint, upper arm"'


@pytest.fixture(scope="module")
def gateway(built: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Gateway]:
    """`canopend` as node 100 on the bus of a virtual axis."""
    folder = tmp_path_factory.mktemp("axis")
    with virtual_axis(folder) as bus, party(built, "canopend", bus, FOREIGN, folder, ("-c", "stdio")) as canopend:
        yield Gateway(canopend)


@pytest.fixture(params=[0, 1], ids=["segmented", "block"])
def transfer(request: pytest.FixtureRequest, gateway: Gateway) -> Gateway:
    """The gateway, which sends what is long in the one way or the other."""
    assert gateway.ask(f"set sdo_block {request.param}") == "OK"
    return gateway


@pytest.mark.parametrize(
    ("node_id", "index", "subindex", "kind", "value"),
    [
        (AMPLIFIER, 0x1000, 0, "x32", "0x00020192"),
        (ENCODER, 0x1000, 0, "x32", "0x00020196"),
        (AMPLIFIER, 0x1018, 2, "x32", "0x00000402"),
        (ENCODER, 0x1018, 2, "x32", "0x00000406"),
        (AMPLIFIER, 0x6041, 0, "x16", "0x0270"),
        (AMPLIFIER, 0x60C2, 2, "i8", "-3"),
        (AMPLIFIER, 0x607D, 1, "i32", "-2147483648"),
        (ENCODER, 0x6001, 0, "u32", "1048576"),
    ],
)
def test_it_reads_each_type(gateway: Gateway, node_id: int, index: int, subindex: int, kind: str, value: str) -> None:
    assert gateway.read(node_id, index, subindex, kind) == value


@pytest.mark.parametrize(
    ("index", "subindex", "kind", "value"),
    [
        (0x6060, 0, "i8", "10"),
        (0x607E, 0, "u8", "192"),
        (0x6071, 0, "i16", "-250"),
        (0x6068, 0, "u16", "65535"),
        (0x607A, 0, "i32", "-1234567"),
        (0x6067, 0, "u32", "4294967295"),
    ],
)
def test_it_writes_each_type(gateway: Gateway, index: int, subindex: int, kind: str, value: str) -> None:
    before = gateway.read(AMPLIFIER, index, subindex, kind)
    gateway.write(AMPLIFIER, index, subindex, kind, value)
    assert gateway.read(AMPLIFIER, index, subindex, kind) == value
    gateway.write(AMPLIFIER, index, subindex, kind, before)


def test_it_reads_the_whole_dictionary_file(transfer: Gateway) -> None:
    read = transfer.read(ENCODER, 0x1021, 0, "d")
    assert base64.b64decode(read) == (EDS / "encoder.eds").read_bytes()


@pytest.mark.parametrize(("index", "kind", "value"), [(0x2002, "vs", LABEL), (0x2004, "d", DATA)])
def test_it_writes_what_is_long(transfer: Gateway, index: int, kind: str, value: str) -> None:
    transfer.write(AMPLIFIER, index, 0, kind, value)
    assert transfer.read(AMPLIFIER, index, 0, kind) == value
    transfer.write(AMPLIFIER, index, 0, kind, '"x"' if kind == "vs" else "eA==")
    assert len(transfer.read(AMPLIFIER, index, 0, kind)) <= 4, "nothing of the longer one is left"


@pytest.mark.parametrize(
    ("command", "code"),
    [
        ("r 0x7000 0 u8", Abort.NO_SUCH_OBJECT),
        ("r 0x6060 9 u8", Abort.NO_SUCH_SUBINDEX),
        ("r 0x2003 0 u32", Abort.READ_OF_WRITE_ONLY),
        ('w 0x1008 0 vs "another name for it"', Abort.WRITE_OF_READ_ONLY),
        ("w 0x6060 0 u16 10", Abort.LENGTH_MISMATCH),
        ("w 0x6060 0 i8 -3", Abort.VALUE_TOO_LOW),
        ("w 0x605A 0 i16 9", Abort.VALUE_TOO_HIGH),
        ('w 0x2002 0 vs "a label of more than thirty-two letters"', Abort.TOO_LONG),
        ("w 0x1010 1 u32 1", Abort.CANNOT_STORE),
        ("w 0x1019 0 u8 1", Abort.VALUE_RANGE),
    ],
)
def test_it_is_refused_with_the_right_code(transfer: Gateway, command: str, code: int) -> None:
    assert transfer.refusal(f"{AMPLIFIER} {command}") == code
    assert transfer.read(AMPLIFIER, 0x1000, 0, "x32") == "0x00020192", "the server serves on"


def test_it_maps_a_pdo_in_the_right_order_alone(gateway: Gateway) -> None:
    def write(index: int, subindex: int, kind: str, value: int) -> str:
        return f"{AMPLIFIER} w 0x{index:04X} {subindex} {kind} {value}"

    velocity, not_mappable, too_much = 0x606C0020, 0x10080020, 0x60FD0020
    gateway.ask(f"{AMPLIFIER} preop")
    assert gateway.ask(write(0x1802, 1, "u32", 0x80000381)) == "OK"
    assert gateway.ask(write(0x1A02, 0, "u8", 0)) == "OK"
    assert gateway.refusal(write(0x1A02, 1, "u32", not_mappable)) == Abort.NOT_MAPPABLE
    for place, entry in enumerate((velocity, 0x60640020, too_much), start=1):
        gateway.ask(write(0x1A02, place, "u32", entry))
    assert gateway.refusal(write(0x1A02, 0, "u8", 3)) == Abort.PDO_TOO_LONG
    assert gateway.ask(write(0x1A02, 0, "u8", 2)) == "OK"
    assert gateway.ask(write(0x1802, 2, "u8", 1)) == "OK"
    assert gateway.ask(write(0x1802, 1, "u32", 0x381)) == "OK"
    assert gateway.read(AMPLIFIER, 0x1A02, 1, "u32") == str(velocity)


def test_it_follows_each_state_by_the_heartbeats(gateway: Gateway) -> None:
    for row, node_id in enumerate((AMPLIFIER, ENCODER)):
        gateway.write(FOREIGN, 0x1016, row + 1, "u32", node_id << 16 | 1000)
        gateway.write(node_id, 0x1017, 0, "u16", 20)
        for command, state in (
            ("start", "operational"),
            ("stop", "stopped"),
            ("preop", "pre-operational"),
            ("start", "operational"),
            ("reset comm", "initializing"),
        ):
            before = gateway.party.log.count(HEARTBEAT.format(node_id, row, state))
            assert gateway.ask(f"{node_id} {command}") == "OK"
            gateway.party.wait_for(HEARTBEAT.format(node_id, row, state), before + 1)
        gateway.write(FOREIGN, 0x1016, row + 1, "u32", 0)


def test_a_stopped_node_answers_no_sdo(gateway: Gateway) -> None:
    gateway.ask(f"{ENCODER} stop")
    assert gateway.refusal(f"{ENCODER} r 0x1000 0 u32") == Abort.TIME_OUT
    gateway.ask(f"{ENCODER} preop")
    assert gateway.read(ENCODER, 0x1000, 0, "x32") == "0x00020196"


def test_a_reset_puts_the_defaults_back(gateway: Gateway) -> None:
    gateway.write(AMPLIFIER, 0x6067, 0, "u32", 7)
    gateway.write(AMPLIFIER, 0x1017, 0, "u16", 20)
    gateway.write(FOREIGN, 0x1016, 1, "u32", AMPLIFIER << 16 | 1000)
    booted = HEARTBEAT.format(AMPLIFIER, 0, "initializing")
    before = gateway.party.log.count(booted)
    gateway.ask(f"{AMPLIFIER} reset node")
    gateway.party.wait_for(booted, before + 1)
    assert gateway.read(AMPLIFIER, 0x6067, 0, "u32") == "100"
    assert gateway.read(AMPLIFIER, 0x1017, 0, "u16") == "0"
    gateway.write(FOREIGN, 0x1016, 1, "u32", 0)


def test_the_amplifier_tells_it_that_its_heartbeat_is_missing(gateway: Gateway) -> None:
    missing = EMERGENCY.format(AMPLIFIER, 0x8130)
    gateway.write(AMPLIFIER, 0x1016, 1, "u32", FOREIGN << 16 | 200)
    gateway.write(FOREIGN, 0x1017, 0, "u16", 20)
    gateway.ask(f"{AMPLIFIER} start")
    assert gateway.read(AMPLIFIER, 0x1001, 0, "u8") == "0"
    gateway.write(FOREIGN, 0x1017, 0, "u16", 0)
    gateway.party.wait_for(missing)
    assert int(gateway.read(AMPLIFIER, 0x1003, 1, "u32")) & 0xFFFF == 0x8130
    assert int(gateway.read(AMPLIFIER, 0x1001, 0, "u8")) & 0x10, "the communication bit of the error register"
    gateway.write(AMPLIFIER, 0x1016, 1, "u32", 0)
    gateway.ask(f"{AMPLIFIER} reset node")


def test_it_misses_the_heartbeat_of_a_stopped_producer(gateway: Gateway) -> None:
    gateway.write(FOREIGN, 0x1016, 1, "u32", ENCODER << 16 | 200)
    gateway.write(ENCODER, 0x1017, 0, "u16", 20)
    gateway.party.wait_for(HEARTBEAT.format(ENCODER, 0, "pre-operational"))
    gateway.write(ENCODER, 0x1017, 0, "u16", 0)
    gateway.party.wait_for(EMERGENCY.format(FOREIGN, 0x8130))
    gateway.write(FOREIGN, 0x1016, 1, "u32", 0)


def test_it_selects_and_asks_a_node_by_lss(gateway: Gateway) -> None:
    identity = [int(gateway.read(ENCODER, 0x1018, subindex, "u32")) for subindex in (1, 2, 3, 4)]
    assert gateway.ask(f"lss_switch_sel {' '.join(map(str, identity))}") == "OK"
    assert int(gateway.ask("lss_get_node"), 0) == ENCODER
    found = re.findall(r"0x[0-9A-F]{8}", gateway.ask("lss_inquire_addr 1"))
    assert [int(number, 16) for number in found] == [identity[1]]
    assert gateway.ask("lss_switch_glob 0") == "OK"
