"""What a recording may hold: every format is counted while it is read, and refused before it fills the memory."""

from __future__ import annotations

import gzip
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.io import savemat

from servod.common.errors import BadInput
from servod.formats.recording.mcap_reader import TIME, read_recording
from servod.formats.recording.record import FIELDS, CycleRecord
from servod.lab.recordings import load_recording, readers
from tests.fuzz.recordings_bombs import csv_bomb, mat_bomb
from tests.lab.recordings.mcap_file import write_mcap

COLUMNS = {"t_s": np.arange(60) * 1e-3, "torque_nm": np.zeros(60), "position_rad": np.arange(60) * 1e-4}
#: What load_recording keeps of the daemon's own: time and the columns with canonical names.
OWN_COLUMNS = 7
CYCLE = CycleRecord(*(0 if f.kind == "q" else 0.0 for f in FIELDS))  # type: ignore[arg-type]

#: Reads a file under the limits of the fuzzer's judge; tells the growth of its memory in MiB, and the error.
CHILD = """
import resource, sys
import pyarrow.csv
from servod.common.errors import BadInput
from servod.lab.recordings import load_recording
def resident_kib():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
before = resident_kib()
most = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize() + 3 * 1024**3
resource.setrlimit(resource.RLIMIT_AS, (most, most))
try:
    load_recording(sys.argv[1])
except BadInput as error:
    print((resident_kib() - before) // 1024, error)
"""


def text(rows: int) -> bytes:
    lines = zip(*(values[:rows].tolist() for values in COLUMNS.values()), strict=True)
    return (",".join(COLUMNS) + "\n" + "".join(f"{t},{u},{x}\n" for t, u, x in lines)).encode()


def own(rows: int) -> list[CycleRecord]:
    return [CYCLE._replace(time_ns=n * 10**6, position_rad=1e-4 * n) for n in range(rows)]


def cut(rows: int) -> dict[str, np.ndarray]:
    return {name: values[:rows] for name, values in COLUMNS.items()}


WRITERS: dict[str, Callable[[Path, int], object]] = {
    ".csv": lambda path, cells: path.write_bytes(text(cells // 3)),
    ".csv.gz": lambda path, cells: path.write_bytes(gzip.compress(text(cells // 3))),
    ".parquet": lambda path, cells: pq.write_table(pa.table(cut(cells // 3)), path, row_group_size=7),
    ".mat": lambda path, cells: savemat(path, cut(cells // 3)),
    "-v7.mat": lambda path, cells: savemat(path, cut(cells // 3), do_compression=True),
    ".mcap": lambda path, cells: write_mcap(path, own(cells // OWN_COLUMNS)),
}


@pytest.mark.parametrize("suffix", WRITERS)
def test_a_recording_at_the_limit_is_read_and_one_beyond_is_refused(
    suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(readers, "MOST_CELLS", 126)
    WRITERS[suffix](tmp_path / f"fits{suffix}", 126)
    WRITERS[suffix](tmp_path / f"large{suffix}", 133)
    assert len(load_recording(tmp_path / f"fits{suffix}")) == (18 if suffix == ".mcap" else 42)
    with pytest.raises(BadInput, match=r"large.*: found \d+ .* columns; allowed: at most 126 numbers"):
        load_recording(tmp_path / f"large{suffix}")


@pytest.mark.parametrize("suffix", [".csv", ".csv.gz", ".mat", "-v7.mat"])
def test_bytes_are_counted_as_well(suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    WRITERS[suffix](tmp_path / f"r{suffix}", 180)
    monkeypatch.setattr(readers, "MOST_BYTES", 100)
    if suffix == ".mat":  # of what is not packed, the file's own size is looked at
        monkeypatch.setattr("servod.lab.recordings.readers.MOST_BYTES", 100)
    with pytest.raises(BadInput, match=r"found \d+ bytes.*allowed: at most 100 bytes"):
        load_recording(tmp_path / f"r{suffix}")


@pytest.mark.parametrize(("name", "make"), [("r.csv.gz", csv_bomb), ("r.mat", mat_bomb)])
def test_a_small_file_that_unpacks_to_gigabytes_is_refused_in_bounded_memory(
    name: str, make: Callable[[], bytes], tmp_path: Path
) -> None:
    (tmp_path / name).write_bytes(make())
    assert (tmp_path / name).stat().st_size < 1024**2
    done = subprocess.run([sys.executable, "-c", CHILD, tmp_path / name], capture_output=True, text=True, check=True)
    grown_mib, said = done.stdout.split(" ", 1)
    assert f"at most {readers.MOST_CELLS} numbers" in said
    assert int(grown_mib) < 1536, done.stdout


def test_a_bomb_that_is_cut_short_lets_the_process_end(tmp_path: Path) -> None:
    """A thread of Arrow's that read ahead once went on behind the error, and the process never ended."""
    (tmp_path / "r.csv.gz").write_bytes(csv_bomb()[:100_000])
    for _ in range(2):
        done = subprocess.run(
            [sys.executable, "-c", CHILD, tmp_path / "r.csv.gz"],
            capture_output=True, text=True, check=True, timeout=60,
        )  # fmt: skip
        assert "allowed: a gzip file that is whole" in done.stdout


def test_columns_that_are_not_used_count_for_nothing_but_are_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(readers, "MOST_CELLS", 3 * 60)
    lists = pa.array([[float(n) for n in range(100)]] * 60)
    pq.write_table(pa.table({**COLUMNS, "lists": lists, "more": COLUMNS["t_s"]}), tmp_path / "r.parquet")
    assert load_recording(tmp_path / "r.parquet").report == ("columns not used: lists, more",)


def test_text_that_a_parquet_file_repeats_is_not_unpacked(tmp_path: Path) -> None:
    pq.write_table(pa.table({**COLUMNS, "torque_nm": pa.array(["0.1"] * 60)}), tmp_path / "r.parquet")
    with pytest.raises(BadInput, match=r"column torque_nm: found values of type string; allowed: numbers"):
        load_recording(tmp_path / "r.parquet")


def test_own_recording_keeps_the_names_that_are_wanted(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "run.mcap", own(30))
    whole, part = read_recording(path), read_recording(path, {"position_rad"}, most_cells=60)
    assert part.names == (TIME, "position_rad") and len(part) == 30
    assert part.column("position_rad") == whole.column("position_rad") and part.column(TIME) == whole.column(TIME)
    assert set(part.left_out) == set(whole.names) - set(part.names)
    with pytest.raises(BadInput, match=r"30 cycles or more of 2 columns; .* recorder.max_file_mib"):
        read_recording(path, {"position_rad"}, most_cells=59)


def test_own_recording_that_unpacks_to_more_is_refused_with_a_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_mcap(tmp_path / "run.mcap", own(30))
    monkeypatch.setattr("servod.formats.recording.mcap_reader._UNPACKED_LIMIT_BYTES", 10_000)
    with pytest.raises(BadInput, match=r"more than 10000 bytes unpacked; .* recorder.max_file_mib"):
        read_recording(path)
