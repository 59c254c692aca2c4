"""EDS and behaviour agree (CiA 306): each entry of both files is read and written."""

from __future__ import annotations

from configparser import RawConfigParser
from pathlib import Path

import pytest

from servod import drivers
from tests.drivers.virtual.bench import AMPLIFIER, ENCODER, AbortedError, Bench

EDS = Path(drivers.__file__).parent / "eds"
FILES = {AMPLIFIER: EDS / "amplifier.eds", ENCODER: EDS / "encoder.eds"}
SIZES = {2: 1, 3: 2, 4: 4, 5: 1, 6: 2, 7: 4, 0x1B: 8}
#: What an access may meet although type, access and range are right: state and meaning of the object.
EMPTY_HISTORY = 0x08000024
BY_MEANING = (0x08000022, 0x08000020, 0x06090030, 0x06040043)


def entries(node_id: int) -> list[tuple[int, int, dict[str, str]]]:
    """All variables of the file, by plain configparser: not by the reader that the node uses."""
    parser = RawConfigParser()
    parser.optionxform = str  # type: ignore[assignment,method-assign]
    parser.read(FILES[node_id])
    found = []
    for section in parser.sections():
        name, _, subindex = section.partition("sub")
        options = dict(parser[section])
        if len(name) == 4 and "DataType" in options:
            found.append((int(name, 16), int(subindex or "0", 16), options))
    return found


def cases() -> list[tuple[int, int, int, dict[str, str]]]:
    return [(node_id, *entry) for node_id in FILES for entry in entries(node_id)]


@pytest.fixture(scope="module")
def shared() -> Bench:
    return Bench()


@pytest.mark.parametrize("node_id", FILES)
def test_lists_name_every_object(node_id: int) -> None:
    parser = RawConfigParser()
    parser.read(FILES[node_id])
    listed = []
    for name in ("MandatoryObjects", "OptionalObjects", "ManufacturerObjects"):
        count = parser.getint(name, "supportedobjects")
        listed += [int(parser[name][str(i)], 16) for i in range(1, count + 1)]
    present = [int(s, 16) for s in parser.sections() if len(s) == 4]
    assert sorted(listed) == sorted(present)


@pytest.mark.parametrize(("node_id", "index", "subindex", "options"), cases())
def test_read(shared: Bench, node_id: int, index: int, subindex: int, options: dict[str, str]) -> None:
    kind, access = int(options["DataType"], 16), options["AccessType"]
    if index == 0x1021:  # the whole file: see the block transfer of the witness
        assert shared.world.devices.nodes[node_id - 1].dictionary.entry(index).raw == FILES[node_id].read_bytes()
        return
    try:
        value = shared.upload(node_id, index, subindex)
    except AbortedError as error:
        expected = 0x06010001 if access == "wo" else EMPTY_HISTORY
        assert (error.code, index == 0x1003 or access == "wo") == (expected, True)
        return
    assert access != "wo"
    assert kind not in SIZES or len(value) == SIZES[kind]


@pytest.mark.parametrize(("node_id", "index", "subindex", "options"), cases())
def test_write(shared: Bench, node_id: int, index: int, subindex: int, options: dict[str, str]) -> None:
    kind, access = int(options["DataType"], 16), options["AccessType"]
    writable = access in ("rw", "rww", "rwr", "wo")
    if kind not in SIZES:
        code = write(shared, node_id, index, subindex, None)
        assert code == (0 if writable else 0x06010002)
        return
    low = int(options.get("LowLimit", options.get("DefaultValue", "0").replace("$NODEID+", "")), 0)
    code = write(shared, node_id, index, subindex, (low, min(SIZES[kind], 4)))
    if not writable:
        assert code == 0x06010002
        return
    assert code == 0 or code in BY_MEANING
    if code == 0 and access != "wo" and index not in (0x1010, 0x1011):
        assert shared.read(node_id, index, subindex, signed=kind <= 4) == low
    assert write(shared, node_id, index, subindex, (0, SIZES[kind] % 4 + 1)) in (0x06070010, 0x06010002)
    if "HighLimit" in options and int(options["HighLimit"], 0) < (1 << 8 * SIZES[kind] - 1) - 1:
        too_high = write(shared, node_id, index, subindex, (int(options["HighLimit"], 0) + 1, SIZES[kind]))
        assert too_high == 0x06090031


def write(bench: Bench, node_id: int, index: int, subindex: int, value: tuple[int, int] | None) -> int:
    """Write a number of a size, or a short string; the abort code, or 0."""
    try:
        if value is None:
            bench.write_segments(node_id, index, subindex, b"text")
        else:
            bench.write(node_id, index, subindex, *value)
    except AbortedError as error:
        return error.code
    return 0
