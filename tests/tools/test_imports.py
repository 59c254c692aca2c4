"""Imports run one way: the rules stand in pyproject.toml, and import-linter holds the tree to them.

What a rule on files cannot say is tested here on processes: what is really loaded when the core starts.
"""

from __future__ import annotations

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import source

LAB = {"numpy", "scipy", "numba", "llvmlite", "matplotlib", "pyarrow", "cvxpy", "clarabel", "scs", "pandas"}
CORE = [
    "servod.runtime.daemon.main",
    "servod.runtime.loop.process",
    "servod.drivers.cia402",
    "servod.drivers.cia406",
    "servod.cli",
]


def loaded_with(module: str) -> set[str]:
    """All modules that a fresh process has after importing this one."""
    code = f"import sys, {module}; print(' '.join(sys.modules))"
    return set(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split())


def test_the_rules_of_import_are_kept() -> None:
    lint = Path(sys.executable).with_name("lint-imports")
    result = subprocess.run([lint, "--no-cache"], cwd=source.ROOT, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr


def test_every_driver_of_a_device_is_held_to_the_rules_beside_the_machine() -> None:
    contracts = tomllib.loads((source.ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    (held,) = (c["source_modules"] for c in contracts if c["name"] == "Beside the machine nothing of the laboratory")
    drivers = {f"servod.drivers.{file.stem}" for file in (source.ROOT / "drivers").glob("*.py")}
    assert drivers - {"servod.drivers.__init__"} == {name for name in held if name != "servod.runtime"}


def test_nobody_imports_the_bare_folder() -> None:
    wrong = [
        f"{file.relative_to(source.ROOT)}:{line}"
        for file in source.files()
        for name, line in source.imports(file)
        if name == "drivers" or name.startswith("drivers.")
    ]
    assert wrong == []


@pytest.mark.parametrize("module", CORE)
def test_the_core_loads_nothing_of_the_laboratory(module: str) -> None:
    assert {name.split(".")[0] for name in loaded_with(module)} & LAB == set()


def test_the_loop_loads_neither_canopen_nor_python_can() -> None:
    loaded = {name.split(".")[0] for name in loaded_with("servod.runtime.loop.process")}
    assert loaded & {"canopen", "can", "typer", "rich", "mcap"} == set()


def test_the_command_line_starts_without_the_daemon_and_the_laboratory() -> None:
    heavy = ("servod.runtime.daemon", "servod.runtime.loop", "servod.runtime.fieldbus.master", "canopen", "mcap")
    assert not {name for name in loaded_with("servod.cli") if name.startswith(heavy)}


def test_the_fault_campaign_runs_where_the_laboratory_is_not_installed() -> None:
    assert {name.split(".")[0] for name in loaded_with("servod.qualify.faults.run")} & LAB == set()
