"""Reading recordings: every format gives the same columns; holes are reported and filled; mistakes are named."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.io import savemat

from servod.common.errors import BadInput
from servod.formats.model.axis_model import AxisKind
from servod.formats.recording.record import FIELDS, CycleRecord
from servod.lab.recordings import Quantity, load_recording
from servod.lab.recordings.readers import widened
from servod.lab.recordings.recording import missing_samples

T = np.arange(50) * 1e-3
U = 0.1 * np.sin(T)
X = 0.01 * np.cos(T)


def rows(header: str = "t_s,torque_nm,position_rad", **change: str) -> str:
    """CSV text of the standard recording; `change` maps `r<number>` to a whole row."""
    lines = [f"{t:.6f},{u:.9g},{x:.9g}" for t, u, x in zip(T, U, X, strict=True)]
    for key, line in change.items():
        lines[int(key[1:])] = line
    return "\n".join([header, *lines]) + "\n"


def written(folder: Path, text: str, name: str = "r.csv") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def test_every_format_reads_alike(tmp_path: Path) -> None:
    written(tmp_path, rows())
    (tmp_path / "r.csv.gz").write_bytes(gzip.compress(rows().encode()))
    pq.write_table(pa.table({"t_s": T, "torque_nm": U, "position_rad": X}), tmp_path / "r.parquet")
    savemat(tmp_path / "r.mat", {"t_s": T[:, None], "torque_nm": U, "position_rad": X, "scalar": 1.0})
    for name in ("r.csv", "r.csv.gz", "r.parquet", "r.mat"):
        recording = load_recording(tmp_path / name)
        assert recording.axis is AxisKind.ROTARY
        assert np.allclose(recording.t_s, T) and np.allclose(recording.torque, U, rtol=1e-8)
        assert np.allclose(recording.position, X) and recording.report == ()


def test_own_recording_reads(tmp_path: Path) -> None:
    from tests.lab.recordings.mcap_file import write_mcap

    cycles = [
        CycleRecord(**{f.name: 0 if f.kind == "q" else 0.0 for f in FIELDS})._replace(
            time_ns=10**9 + k * 10**6, position_rad=0.1 * k, torque_nm=0.5, reference_rad=1.0
        )
        for k in range(30)
    ]
    recording = load_recording(write_mcap(tmp_path / "run.mcap", cycles))
    assert np.allclose(recording.t_s, np.arange(30) * 1e-3)
    assert np.allclose(recording.position, 0.1 * np.arange(30))
    assert recording.get(Quantity.REFERENCE) is not None


def test_map_renames_and_scales(tmp_path: Path) -> None:
    savemat(tmp_path / "r.mat", {"d": {"t": T, "vir": U, "qm": X}})
    mapped = written(
        tmp_path, "columns: {t_s: d.t, force_n: {from: d.vir, scale: 35e0, offset: 1}, position_m: d.qm}", "m.yaml"
    )
    recording = load_recording(tmp_path / "r.mat", mapped)
    assert recording.axis is AxisKind.LINEAR
    assert np.allclose(recording.torque, 35.0 * U + 1.0)


def test_holes_are_filled_and_reported(tmp_path: Path) -> None:
    text = rows(r5=f"{T[5]},,{X[5]}", r6=f"{T[6]},nan,{X[6]}", r9=f"{T[9]},0.3,", r12=f",0.4,{X[12]}")
    recording = load_recording(written(tmp_path, text))
    assert recording.torque[5] == recording.torque[6] == pytest.approx(U[4])
    assert recording.position[9] == pytest.approx(X[9], abs=1e-8) and not recording.measured[9]
    assert recording.t_s[12] == pytest.approx(0.012)
    assert [line.split(":")[0] for line in recording.report] == ["t_s", "torque_nm", "position_rad"]
    assert "2 missing cells (first in row 6)" in recording.report[1]


def test_gaps_jitter_and_doubled_stamps_are_reported(tmp_path: Path) -> None:
    lines = rows().splitlines()
    gap = load_recording(written(tmp_path, "\n".join(lines[:20] + lines[30:])))
    assert "about 10 samples missing" in gap.report[0] and "0.011 s" in gap.report[0]
    doubled = load_recording(written(tmp_path, "\n".join([*lines[:20], lines[19], *lines[20:]])))
    assert "twice" in doubled.report[0]
    jitter = T + 3e-4 * np.sin(1e5 * T)
    uneven = "\n".join([lines[0], *(f"{t},0,0.1" for t in jitter)])
    assert "uneven" in load_recording(written(tmp_path, uneven)).report[-1]


@given(
    dropped=st.sets(st.integers(1, 58)),
    late=st.lists(st.floats(0.0, 0.9), min_size=60, max_size=60),
    numbered=st.booleans(),
)
def test_samples_are_missing_where_cycles_are(dropped: set[int], late: list[float], numbered: bool) -> None:
    """By numbers however late each cycle was; by stamps where one of them was late, with its neighbours in time."""
    kept = np.array([k for k in range(60) if k not in dropped])
    assume(np.median(np.diff(kept)) == 1.0)
    if numbered:
        found = missing_samples(1e-3 * (kept + np.array(late)[kept]), kept.astype(float))
        assert np.array_equal(found, np.diff(kept) - 1)
    else:
        stamps, one = kept.astype(float), len(kept) // 2
        assume(np.all(np.diff(kept[one - 1 : one + 2]) == 1))
        stamps[one] += late[0]
        assert missing_samples(1e-3 * stamps).sum() == len(dropped)


MISTAKES = {
    "no time": (rows("time,torque_nm,position_rad"), ["t_s", "time"]),
    "no torque": (rows("t_s,torque,position_rad"), ["torque_nm", "--map"]),
    "no position": (rows("t_s,force_n,position_rad"), ["position_m"]),
    "a word": (rows(r3="0.003,much,0.1"), ["torque_nm", "row 4", "much"]),
    "short row": (rows(r3="0.003,0.1"), ["cells"]),
    "backwards": (rows(r3="0.001,0.1,0.1"), ["t_s", "row 4", "forward"]),
    "standing time": ("t_s,torque_nm,position_rad\n" + "1,0,0\n" * 20, ["t_s", "forward"]),
    "too short": ("t_s,torque_nm,position_rad\n0,0,0\n", ["rows", "10"]),
    "header only": ("t_s,torque_nm,position_rad\n", ["rows"]),
    "empty": ("", ["empty"]),
    "twice": (rows("t_s,torque_nm,torque_nm"), ["torque_nm", "twice"]),
    "mostly holes": (
        "t_s,torque_nm,position_rad\n" + "".join(f"{t},,0.1\n" for t in T),
        ["torque_nm", "50 of 50"],
    ),
}


@pytest.mark.parametrize("case", MISTAKES)
def test_a_broken_csv_is_named(case: str, tmp_path: Path) -> None:
    text, words = MISTAKES[case]
    with pytest.raises(BadInput) as error:
        load_recording(written(tmp_path, text))
    assert str(tmp_path / "r.csv") in str(error.value)
    for word in words:
        assert word in str(error.value)


@pytest.mark.parametrize("name", ["r.txt", "r.mat", "r.parquet", "r.mcap", "r.csv.gz"])
def test_a_foreign_file_is_named(name: str, tmp_path: Path) -> None:
    path = written(tmp_path, "this is no recording of any kind\n" * 20, name)
    with pytest.raises(BadInput, match=name):
        load_recording(path)


def test_a_missing_file_and_bad_maps_are_named(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="no such file"):
        load_recording(tmp_path / "none.csv")
    path = written(tmp_path, rows())
    for text, word in (
        ("columns: {t_ms: t}", "t_ms"),
        ("columns: {t_s: time}", "time"),
        ("columns: {t_s: {from: t_s, factor: 2}}", "factor"),
        ("columns: {}", "columns"),
        ("t_s: t", "columns"),
    ):
        with pytest.raises(BadInput, match=word):
            load_recording(path, written(tmp_path, text, "m.yaml"))


def test_a_stretch_of_time_is_cut_out_and_told(tmp_path: Path) -> None:
    recording = load_recording(written(tmp_path, rows()))
    part = recording.between(float(T[5]), float(T[25]))
    assert np.allclose(part.t_s, T[5:25]) and np.allclose(part.torque, U[5:25], rtol=1e-8)
    assert len(part.measured) == 20 and "as asked" in part.report[-1]
    assert recording.between(None, None) is recording
    with pytest.raises(BadInput, match=r"r\.csv: column t_s: found 0 rows from 1000"):
        recording.between(1000.0, None)


def test_numbers_of_four_bytes_are_the_decimals_that_were_written(tmp_path: Path) -> None:
    """No staircase in time and position: steps stay even, also a quarter of an hour from the begin."""
    t_s = np.round(900.0 + 1e-3 * np.arange(5000), 3)
    position = np.round(3.0 + 1e-5 * np.arange(5000), 5)
    assert np.diff(t_s.astype(np.float32).astype(np.float64)).std() > 1e-6
    for values in (t_s, position, np.array([0.0, -0.1, np.nan, np.inf, 1e-30])):
        assert np.array_equal(widened(values.astype(np.float32)), values, equal_nan=True)
    table = {"t_s": t_s.astype(np.float32), "torque_nm": position, "position_rad": position.astype(np.float32)}
    pq.write_table(pa.table(table), tmp_path / "a.parquet")
    recording = load_recording(tmp_path / "a.parquet")
    assert np.array_equal(recording.t_s, t_s) and np.array_equal(recording.position, position)
    drawn = np.random.default_rng(1).integers(0, 2**32, 100_000, dtype=np.uint32).view(np.float32)
    assert np.array_equal(widened(drawn).astype(np.float32), drawn, equal_nan=True)
