"""A DCF's parameter values reach the node, are read back, and never override what the bring-up itself decides."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from witness import EDS, Witness, axis_config, master, witness

from servod.errors import Unreachable
from servod.master.dcf import parameters
from servod.master.eds import load_dictionary


@pytest.fixture
def world() -> Iterator[Witness]:
    with witness() as instance:
        yield instance


@pytest.fixture
def dcf(tmp_path: Path) -> str:
    """The shipped amplifier, configured: another rated torque, quick-stop ramp, option, status word and heartbeat."""
    values = {"6076": "0x280", "6085": "12345", "605A": "5", "6041": "7", "1017": "999"}
    lines = []
    for line in (EDS / "amplifier.eds").read_text().splitlines():
        lines.append(line)
        if line.startswith("[") and (value := values.get(line.strip("[]"))):
            lines.append(f"ParameterValue={value}")
    path = tmp_path / "configured.dcf"
    path.write_text("\n".join(lines) + "\n")
    return str(path)


def test_only_writable_objects_of_the_device_are_taken(dcf: str) -> None:
    found = list(parameters(load_dictionary(dcf, 1)))
    assert found == [(0x605A, 0, 5), (0x6076, 0, 640), (0x6085, 0, 12345)]


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
