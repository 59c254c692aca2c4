"""Files that are none: pipes, devices, folders, loops of links and files without end, to every reader by its name."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from servod.cli.track import read_motion
from servod.common.errors import BadInput
from servod.formats.config import load_config
from servod.formats.gains.gain_set import load_gains
from servod.formats.model.axis_model import load_axis_model
from servod.formats.recording.mcap_reader import read_recording
from servod.lab.recordings import load_column_map, load_recording
from servod.runtime.fieldbus.master.eds import load_dictionary

READERS: dict[str, tuple[Callable[[Path], object], str]] = {
    "configuration": (load_config, ".yaml"),
    "gains": (load_gains, ".yaml"),
    "axis model": (load_axis_model, ".yaml"),
    "column map": (load_column_map, ".yaml"),
    "EDS": (lambda path: load_dictionary(path, 1), ".eds"),
    "motion": (read_motion, ".csv"),
    "daemon's recording": (read_recording, ".mcap"),
    **{
        f"recording {suffix}": (load_recording, suffix)
        for suffix in (".csv", ".csv.gz", ".txt", ".parquet", ".mat", ".npy", ".npz", ".json", ".jsonl", ".mcap")
    },
}


def _pipe(path: Path) -> None:
    os.mkfifo(path)


def _loop(path: Path) -> None:
    path.symlink_to(path)


def _endless(path: Path) -> None:
    """Two terabytes that take no room on the disk."""
    with path.open("wb") as file:
        file.truncate(2 * 1024**4)


ODD: dict[str, Callable[[Path], None]] = {
    "missing": lambda path: None,
    "folder": Path.mkdir,
    "pipe": _pipe,
    "device": lambda path: path.symlink_to("/dev/zero"),
    "loop of links": _loop,
    "link to nothing": lambda path: path.symlink_to("nowhere"),
    "no content": Path.touch,
    "no end": _endless,
}


@pytest.mark.timeout(20)
@pytest.mark.parametrize("make", ODD.values(), ids=ODD)
@pytest.mark.parametrize(("read", "suffix"), READERS.values(), ids=READERS)
def test_what_is_no_file_is_refused_in_one_line(
    read: Callable[[Path], object], suffix: str, make: Callable[[Path], None], tmp_path: Path
) -> None:
    path = tmp_path / f"odd{suffix}"
    make(path)
    with pytest.raises(BadInput) as caught:
        read(path)
    line = str(caught.value)
    assert line.startswith(str(path)) and line.isprintable()
    assert not any(word in line for word in ("Errno", "Error", "None", "NoneType", "object at"))
