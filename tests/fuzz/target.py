"""What is fuzzed: one target for each way into servod, as a row of the table, loaded only by the process that runs it.

A target takes bytes, hands them in where files, frames or requests come in, and may end in one of servod's own errors.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hypothesis.strategies import SearchStrategy


@dataclass(frozen=True)
class Target:
    """One way in: `run` hands bytes in, `seeds` are good inputs, `shape` draws inputs that go deeper than noise."""

    run: Callable[[bytes], object]
    seeds: tuple[bytes, ...]
    shape: SearchStrategy[bytes]
    words: tuple[bytes, ...] = ()
    longest: int = 4096


#: Name -> where its target is made; the maker gets a folder of its own.
TARGETS: dict[str, str] = {
    "eds": "tests.fuzz.texts:eds",
    "dcf": "tests.fuzz.texts:dcf",
    "configuration": "tests.fuzz.texts:configuration",
    "gains": "tests.fuzz.texts:gains",
    "gain_store": "tests.fuzz.texts:gain_store",
    "axis_model": "tests.fuzz.texts:axis_model",
    "column_map": "tests.fuzz.texts:column_map",
    "virtual_axis_settings": "tests.fuzz.texts:virtual_axis_settings",
    "config_check": "tests.fuzz.texts:config_check",
    "fault_scenarios": "tests.fuzz.texts:fault_scenarios",
    "motion": "tests.fuzz.texts:motion",
    "csv": "tests.fuzz.recordings:csv",
    "csv_gz": "tests.fuzz.recordings:csv_gz",
    "parquet": "tests.fuzz.recordings:parquet",
    "mat": "tests.fuzz.recordings:mat",
    "txt": "tests.fuzz.recordings_kinds:txt",
    "npy": "tests.fuzz.recordings_kinds:npy",
    "npz": "tests.fuzz.recordings_kinds:npz",
    "json": "tests.fuzz.recordings_kinds:json_rows",
    "ros2": "tests.fuzz.recordings_kinds:ros2",
    "mcap": "tests.fuzz.recordings:mcap",
    "sdo_client": "tests.fuzz.master_side:sdo_client",
    "scan": "tests.fuzz.master_side:scan",
    "bring_up": "tests.fuzz.master_side:bring_up",
    "monitor": "tests.fuzz.master_side:monitor",
    "drivers": "tests.fuzz.master_side:drivers",
    "virtual_axis": "tests.fuzz.axis_side:virtual_axis",
    "virtual_axis_sdo": "tests.fuzz.axis_side:virtual_axis_sdo",
    "control_server": "tests.fuzz.socket_side:control_server",
    "control_client": "tests.fuzz.socket_side:control_client",
}


def load(name: str, folder: Path) -> Target:
    """Make the target `name`, which may keep files in `folder`."""
    module, _, maker = TARGETS[name].partition(":")
    made: Any = getattr(importlib.import_module(module), maker)(folder)
    assert isinstance(made, Target)
    return made
