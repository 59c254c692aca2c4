"""A DCF's parameter values reach the node, are read back, and never override what the bring-up itself decides."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from rig import Rig
from witness import EDS, Witness, axis_config, master, witness

from servod.common.errors import Unreachable
from servod.runtime.fieldbus.cia import Obj402, acts_when_written, decode_status_word
from servod.runtime.fieldbus.devices import DriveState
from servod.runtime.fieldbus.master.eds import load_dictionary
from servod.runtime.fieldbus.master.node import parameters


@pytest.fixture
def world() -> Iterator[Witness]:
    with witness() as instance:
        yield instance


def with_values(folder: Path, values: dict[str, str]) -> str:
    """The shipped amplifier's EDS, made a DCF by values."""
    lines = []
    for line in (EDS / "amplifier.eds").read_text().splitlines():
        lines.append(line)
        if line.startswith("[") and (value := values.get(line.strip("[]"))):
            lines.append(f"ParameterValue={value}")
    path = folder / "configured.dcf"
    path.write_text("\n".join(lines) + "\n")
    return str(path)


@pytest.fixture
def dcf(tmp_path: Path) -> str:
    """The shipped amplifier, configured: another rated torque, quick-stop ramp, option, status word and heartbeat."""
    return with_values(tmp_path, {"6076": "0x280", "6085": "12345", "605A": "5", "6041": "7", "1017": "999"})


def test_only_writable_objects_of_the_device_are_taken(dcf: str) -> None:
    found = list(parameters(load_dictionary(dcf, 1)))
    assert found == [(0x605A, 0, 5), (0x6076, 0, 640), (0x6085, 0, 12345)]


#: What must never be written from a file, and a value that would act: shutdown, enable, a mode, set-points, the brake.
_COMMANDS = {"6040": "0xF", "6060": "8", "6071": "300", "607A": "1000", "60FF": "50", "60B2": "100"}


@pytest.mark.parametrize("control_word", ["6", "0xF"])
def test_nothing_that_acts_is_written_from_a_file(tmp_path: Path, control_word: str) -> None:
    rig = Rig(amplifier={"eds": with_values(tmp_path, _COMMANDS | {"6040": control_word, "6085": "12345"})})
    rig.start()
    (line,) = [line for line in rig.up.report if "they are commands" in line]
    assert "0x6040, 0x6060, 0x6071, 0x607A, 0x60B2, 0x60FF" in line
    sdo = rig.master.sdo(1)
    assert decode_status_word(sdo.read(Obj402.STATUS_WORD)) is DriveState.SWITCH_ON_DISABLED
    assert [sdo.read(index) for index in (0x6040, 0x6060, 0x6071, 0x60B2)] == [0, 10, 0, 0]
    assert sdo.read(0x6085) == 12345


def test_a_parameter_that_powers_the_drive_ends_the_bring_up(world: Witness, dcf: str) -> None:
    """Nobody knows what a maker's object does: the drive is looked at again after the file was written."""

    def powered(*, index: int, subindex: int, od: Any, data: bytes) -> None:
        if index == 0x6085:
            world.amplifier.sdo[Obj402.STATUS_WORD].raw = 0x0237

    world.amplifier.add_write_callback(powered)
    with master(world, axis_config(amplifier={"eds": dcf})) as instance, pytest.raises(Unreachable, match="is powered"):
        instance.bring_up()


@pytest.mark.parametrize(("index", "acts"), [(0x6040, True), (0x6840, True), (0x6003, True), (0x6072, False)])
def test_commands_are_known_on_every_logical_device(index: int, acts: bool) -> None:
    assert acts_when_written(index) is acts


def test_an_eds_gives_no_values() -> None:
    assert list(parameters(load_dictionary(EDS / "amplifier.eds", 1))) == []


def test_values_are_written_and_the_configuration_has_the_last_word(world: Witness, dcf: str) -> None:
    with master(world, axis_config(amplifier={"eds": dcf, "quick_stop_option": 2})) as instance:
        up = instance.bring_up()
    sdo = world.amplifier.sdo
    assert (sdo[0x6076].raw, sdo[0x6085].raw, sdo[0x605A].raw, sdo[0x1017].raw) == (640, 12345, 2, 50)
    assert up.amplifier.facts["rated_torque_nm"] == pytest.approx(0.64)
    assert any("3 parameters written from" in line for line in up.report)


def test_a_value_that_the_node_does_not_keep_is_found(world: Witness, dcf: str) -> None:
    world.amplifier.add_read_callback(lambda *, index, subindex, od: 1 if index == 0x6085 else None)
    config, message = axis_config(amplifier={"eds": dcf}), r"0x6085:0: wrote 12345, device reads 1"
    with master(world, config) as instance, pytest.raises(Unreachable, match=message):
        instance.bring_up()
