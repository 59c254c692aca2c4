import csv
from collections.abc import Callable
from pathlib import Path

import pytest
from daemon_rows import row
from pyarrow import parquet

from servod.common.errors import BadInput
from servod.formats.recording.export import export_csv, export_parquet
from servod.formats.recording.mcap_reader import McapRecording, read_recording
from servod.formats.recording.mcap_writer import McapFile


@pytest.fixture
def recording(tmp_path: Path) -> McapRecording:
    file = McapFile(tmp_path / "a.mcap", {}, 0)
    file.write_rows([row(c, torque_nm=0.1 * c, position_rad=1.0 / 3.0) for c in range(5)])
    file.close()
    return read_recording(tmp_path / "a.mcap")


def test_csv_has_the_columns_that_are_read_and_exact_values(recording: McapRecording, tmp_path: Path) -> None:
    assert export_csv(recording, tmp_path / "a.csv") == 5
    with (tmp_path / "a.csv").open() as stream:
        lines = list(csv.DictReader(stream))
    assert {"t_s", "torque_nm", "position_rad", "reference_rad", "velocity_rad_s"} <= lines[0].keys()
    assert [float(line["t_s"]) for line in lines] == [0.0, 0.001, 0.002, 0.003, 0.004]
    assert float(lines[3]["position_rad"]) == 1.0 / 3.0
    assert not list(tmp_path.glob("*.part"))


def test_parquet_has_the_same_and_the_units(recording: McapRecording, tmp_path: Path) -> None:
    assert export_parquet(recording, tmp_path / "a.parquet") == 5
    table = parquet.read_table(tmp_path / "a.parquet")
    assert table["torque_nm"].to_pylist() == [0.1 * c for c in range(5)]
    assert table.schema.field("torque_nm").metadata[b"unit"] == b"N*m"


def test_target_that_cannot_be_written_is_bad_input(recording: McapRecording, tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="there is no such folder to write it in"):
        export_csv(recording, tmp_path / "nowhere" / "a.csv")


@pytest.mark.parametrize("export", [export_csv, export_parquet])
def test_what_cannot_be_written_whole_leaves_nothing(
    recording: McapRecording, tmp_path: Path, export: Callable[[McapRecording, Path], int]
) -> None:
    target = tmp_path / "out" / "a.table"
    target.mkdir(parents=True)  # the last step, the renaming, fails
    with pytest.raises(BadInput, match="is a folder, a file is needed"):
        export(recording, target)
    assert list(target.parent.iterdir()) == [target]
