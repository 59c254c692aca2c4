"""Drivers by name: the table, entry points, and names that nobody knows."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from servod.common.errors import BadInput
from servod.runtime.fieldbus.registry import DRIVERS, driver_table, load_driver

_METADATA = "Metadata-Version: 2.1\nName: acme-drive\nVersion: 1.0\n"
_MODULE = "from servod.drivers.cia406 import DRIVER\nNOT_A_DRIVER = 5\n"


@pytest.fixture
def installed_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A distribution on sys.path that brings drivers by entry point."""
    info = tmp_path / "acme_drive-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(_METADATA)
    entries = "acme = acme_drive:DRIVER\nbroken = acme_drive:MISSING\nnumber = acme_drive:NOT_A_DRIVER\n"
    (info / "entry_points.txt").write_text(f"[servod.drivers]\n{entries}cia402 = acme_drive:DRIVER\n")
    (tmp_path / "acme_drive.py").write_text(_MODULE)
    monkeypatch.syspath_prepend(str(tmp_path))


def test_every_driver_of_the_table_loads() -> None:
    assert {load_driver(name).kind for name in DRIVERS} == {"amplifier", "encoder"}


@pytest.mark.usefixtures("installed_package")
def test_entry_points_add_drivers_and_never_replace_ours() -> None:
    assert load_driver("acme") is load_driver("cia406")
    assert driver_table()["cia402"] == DRIVERS["cia402"]


@pytest.mark.usefixtures("installed_package")
@pytest.mark.parametrize("name", ["broken", "number"])
def test_a_driver_that_cannot_be_loaded_is_bad_input(name: str) -> None:
    with pytest.raises(BadInput, match=name):
        load_driver(name)


def test_an_unknown_name_says_the_known_ones() -> None:
    with pytest.raises(BadInput, match=r"cia40x.*cia402.*cia406"):
        load_driver("cia40x")


def test_the_cycle_faces_load_neither_canopen_nor_numpy() -> None:
    code = (
        "import sys; from servod.runtime.fieldbus.registry import load_driver; "
        "[load_driver(name).cyclic for name in ('cia402', 'cia406')]; "
        "print([m for m in ('canopen', 'can', 'numpy', 'pydantic') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
