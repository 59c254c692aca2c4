"""A disk that takes no more leaves the file that was there, and nothing beside it."""

from __future__ import annotations

import resource
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from servod.common.errors import BadInput
from servod.common.files import write_file
from servod.formats.recording.export import export_csv, export_parquet, write_table
from servod.formats.recording.mcap_reader import read_recording
from tests.fuzz.recordings import recorded

_MOST_BYTES = 1000
_TABLE = {"t_s": np.arange(5000.0), "position_rad": np.sin(np.arange(5000.0))}

WRITERS: dict[str, tuple[str, Callable[[Path, Path], object]]] = {
    "text": ("set.yaml", lambda path, _folder: write_file(path, "x" * 10_000)),
    "table as CSV": ("table.csv", lambda path, _folder: write_table(path, _TABLE)),
    "table as Parquet": ("table.parquet", lambda path, _folder: write_table(path, _TABLE)),
    "export as CSV": ("run.csv", lambda path, folder: export_csv(read_recording(folder / "run.mcap"), path)),
    "export as Parquet": (
        "run.parquet",
        lambda path, folder: export_parquet(read_recording(folder / "run.mcap"), path),
    ),
}


@contextmanager
def _full_disk() -> Iterator[None]:
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (_MOST_BYTES, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize(("name", "write"), WRITERS.values(), ids=WRITERS)
def test_a_full_disk_leaves_the_old_file_whole_and_no_other(
    name: str, write: Callable[[Path, Path], object], tmp_path: Path
) -> None:
    recorded(tmp_path / "run.mcap")
    path = tmp_path / name
    path.write_text("old")
    with _full_disk(), pytest.raises(BadInput) as caught:
        write(path, tmp_path)
    assert str(path) in str(caught.value)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == sorted(["run.mcap", name])
    assert path.read_text() == "old"
