"""The failure modes per object have every object that the bring-up touches, and every fault that ends a motion."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import pytest
import readme
from test_pages import SAFETY, rows

from servod.common.faults import FAULTS, Reaction
from servod.common.shipped import shipped
from servod.drivers.quirks import QUIRKS
from servod.drivers.virtual.settings import VirtualAxisSettings
from servod.drivers.virtual.world import SteppedWorld
from servod.formats.config import AxisConfig, load_config
from servod.formats.model.axis_model import AxisModel
from servod.runtime.fieldbus.master import BringUp, Master
from servod.runtime.fieldbus.master.sdo import NodeSdo

FMEA = readme.DOCS / "reference/fmea.md"
JOINT = {"inertia": 0.001, "friction": {"kind": "coulomb_viscous", "coulomb": 0.01, "viscous": 0.05}}
#: Without these the axis's objects are the fewest: 0x6084, 0x6085, 0x60FD, 0x60FE.
VARIANTS: list[dict[str, Any]] = [
    {"quick_stop_option": 2, "inputs": {"estop_bit": 16}},
    {"quick_stop_option": 1},
    {"quick_stop_option": 6, "brake": {"by": "output", "output_bit": 16}},
]
#: Communication and mapping parameters of all PDOs of a kind are one row (CiA 301).
PDO_ROWS = (0x1400, 0x1600, 0x1800, 0x1A00)


def config_with(amplifier: dict[str, Any]) -> AxisConfig:
    """The shipped configuration of the virtual axis, with a ramp that is written."""
    plain = load_config(shipped("gains/config/virtual.yaml")).model_dump()
    plain["amplifier"] |= amplifier
    plain["stopping"] |= {"deceleration_rad_s2": 300.0}
    return AxisConfig.model_validate(plain)


def bring_up(amplifier: dict[str, Any]) -> BringUp:
    settings = {"brake": "output"} if "brake" in amplifier else {}
    world = SteppedWorld(VirtualAxisSettings.model_validate(settings), AxisModel.model_validate(JOINT))
    return Master(config_with(amplifier), world.connect(), world.clock, threaded=False).bring_up()


def table() -> Iterator[list[str]]:
    for row in rows(FMEA.read_text()):
        if row[0] != "Object":
            assert len(row) == 5 and all(row), row
            yield row


def listed() -> set[int]:
    """The objects that the first cells name."""
    return {int(index, 16) for row in table() for index in re.findall(r"0x([0-9A-F]{4})", row[0])}


def row_of(index: int) -> int:
    """The object that stands for this one."""
    return max((first for first in PDO_ROWS if first <= index < first + 0x200), default=index)


def test_every_guard_of_the_drive_has_a_row() -> None:
    guards = {row_of(index) for amplifier in VARIANTS for index, _, _ in bring_up(amplifier).amplifier.facts["guards"]}
    assert guards >= {0x1016, 0x1029, 0x1400, 0x2007, 0x6007, 0x605A, 0x605E, 0x6072, 0x607D, 0x6084, 0x6085}
    part = FMEA.read_text().split("\n## Guards of the drive\n")[1].split("\n## ")[0]
    told = {int(index, 16) for row in rows(part) for index in re.findall(r"0x([0-9A-F]{4})", row[0])}
    assert told == guards


def test_every_object_that_the_bring_up_reads_or_writes_has_a_row(monkeypatch: pytest.MonkeyPatch) -> None:
    touched = set[int]()
    read, write = NodeSdo.read, NodeSdo.write

    def reads(sdo: NodeSdo, index: int, subindex: int = 0) -> int:
        touched.add(row_of(index))
        return read(sdo, index, subindex)

    def writes(sdo: NodeSdo, index: int, subindex: int, value: int) -> None:
        touched.add(row_of(index))
        write(sdo, index, subindex, value)

    monkeypatch.setattr(NodeSdo, "read", reads)
    monkeypatch.setattr(NodeSdo, "write", writes)
    for amplifier in VARIANTS:
        up = bring_up(amplifier)
        for pdo in (*up.amplifier.pdos, *up.encoder.pdos):
            touched |= {entry.index for entry in pdo.entries}
    touched |= {wanted.index for quirks in QUIRKS.values() for wanted in quirks.preconditions}
    assert len(touched) > 35
    assert {f"0x{index:04X}" for index in touched - listed()} == set()


def test_every_fault_that_ends_a_motion_stands_in_a_row() -> None:
    part = SAFETY.read_text().split("\n## Failure modes and effects\n")[1].split("\n## ")[0]
    told = " ".join(cell for row in [*rows(part), *table()] for cell in row)
    ending = {fault.code.name for fault in FAULTS.values() if fault.reaction >= Reaction.RAMP_DOWN}
    assert ending >= {"GUARD_CHANGED", "TORQUE_IMPLAUSIBLE", "DUPLICATE_NODE", "OSCILLATES"}
    assert {name for name in ending if f"`{name}`" not in told} == set()


def test_every_code_of_the_page_is_in_the_table_of_faults() -> None:
    known = {code.name for code in FAULTS}
    assert set(re.findall(r"`([A-Z]+(?:_[A-Z]+)+)`", FMEA.read_text())) - known == set()
