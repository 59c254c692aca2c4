"""EDS and DCF as makers write them: what is mended is reported, what cannot be read is one line of BadInput."""

from __future__ import annotations

from pathlib import Path

import pytest
from witness import EDS

from servod.common.errors import BadInput
from servod.runtime.fieldbus.devices import NodePlan, PdoEntry, PdoMap
from servod.runtime.fieldbus.master.eds import dictionary_for, load_dictionary
from servod.runtime.fieldbus.master.node import check_lengths

HEAD = "[FileInfo]\nFileName=x.eds\n[DeviceInfo]\nVendorName=Acme\n"


def variable(index: str, kind: str = "0x0006", default: str = "0", extra: str = "") -> str:
    return (
        f"[{index}]\nParameterName=Thing\nObjectType=0x7\nDataType={kind}\nAccessType=rw\n"
        f"DefaultValue={default}\nPDOMapping=1\n{extra}"
    )


def read(tmp_path: Path, text: str | bytes, node_id: int = 5):  # type: ignore[no-untyped-def]
    path = tmp_path / "drive.eds"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return load_dictionary(path, node_id)


@pytest.mark.parametrize("name", ["amplifier.eds", "encoder.eds"])
def test_the_shipped_files_need_no_mending(name: str) -> None:
    assert load_dictionary(EDS / name, 1).report == []


@pytest.mark.parametrize("default", ["$NODEID+0x180", "0x180+$NODEID", "0x180 + $NODEID", "$nodeid+0x180"])
def test_the_node_id_stands_in_any_order(tmp_path: Path, default: str) -> None:
    dictionary = read(tmp_path, HEAD + variable("1800", "0x0007", default))
    assert dictionary.objects[0x1800].default == 0x185


def test_padded_decimals_are_read_and_reported(tmp_path: Path) -> None:
    dictionary = read(tmp_path, HEAD + variable("6060", "0007", "0010"))
    assert dictionary.objects[0x6060].default == 10
    assert len(dictionary.objects[0x6060]) == 32
    assert dictionary.report == [
        "line 8: DataType=0007 read as decimal 7",
        "line 10: DefaultValue=0010 read as decimal 10",
    ]


def test_duplicates_keep_the_first_and_are_reported(tmp_path: Path) -> None:
    text = HEAD + variable("6060", default="1", extra="DefaultValue=2\n") + variable("6060", default="3")
    dictionary = read(tmp_path, text)
    assert dictionary.objects[0x6060].default == 1
    assert [line.split(":")[1].split(",")[0] for line in dictionary.report] == [
        " key DefaultValue stands twice in its section",
        " section [6060] stands twice",
    ]


def test_latin_1_text_and_windows_line_ends_are_read(tmp_path: Path) -> None:
    text = (HEAD + variable("6060").replace("Thing", "Größe")).replace("\n", "\r\n")
    assert read(tmp_path, text.encode("latin-1")).objects[0x6060].name == "Größe"


def test_unknown_data_types_are_reported(tmp_path: Path) -> None:
    assert "unknown or unsupported data type" in read(tmp_path, HEAD + variable("2000", "0x00A0")).report[0]


def test_a_dcf_brings_its_parameter_values(tmp_path: Path) -> None:
    assert read(tmp_path, HEAD + variable("6085", "0x0007", extra="ParameterValue=42\n")).objects[0x6085].value == 42


@pytest.mark.parametrize(
    "text",
    [
        "",
        "no section\n",
        HEAD,
        HEAD + "[6060]\nObjectType=0x7\n",
        HEAD + variable("6060", "elephant"),
        HEAD + "[6060sub1]\nParameterName=Orphan\n",
        b"\x00\x01\x02\xff\xfe" * 20,
    ],
    ids=["empty", "text", "no objects", "no name", "bad type", "orphan", "binary"],
)
def test_what_is_no_dictionary_is_bad_input(tmp_path: Path, text: str | bytes) -> None:
    with pytest.raises(BadInput, match=r"drive\.eds") as refusal:
        read(tmp_path, text)
    assert "\n" not in str(refusal.value)


def test_a_file_that_is_not_there_is_bad_input(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="there is no such file"):
        load_dictionary(tmp_path / "missing.eds", 1)


def test_a_driver_without_a_generic_dictionary_needs_a_file() -> None:
    with pytest.raises(BadInput, match="acme: eds"):
        dictionary_for("acme", None, 1)


@pytest.mark.parametrize(
    ("index", "bits", "message"),
    [(0x6077, 32, "object 0x6077:0 with 16 bits; allowed: 32 bits"), (0x5FFF, 16, "no object 0x5FFF:0")],
)
def test_a_mapping_that_contradicts_the_eds_is_refused(index: int, bits: int, message: str) -> None:
    plan = NodePlan("cia402", 1, (PdoMap(False, 1, 0x181, 1, (PdoEntry(index, 0, bits),)),))
    with pytest.raises(BadInput, match=message):
        check_lengths(plan, load_dictionary(EDS / "amplifier.eds", 1))
