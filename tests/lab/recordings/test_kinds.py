"""Kinds of file as people have them: one recording, written in many ways, gives the same columns."""

from __future__ import annotations

import gzip
import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.io import savemat

from servod.common.errors import BadInput
from servod.lab.recordings import Quantity, Recording, load_recording, readers

T = np.arange(60) * 1e-3
U = np.round(0.1 * np.sin(40.0 * T), 6)
X = np.round(0.5 * np.cos(40.0 * T), 6)
TABLE = np.column_stack([T, U, X])
BY_NUMBER = "columns: {t_s: 0, torque_nm: 1, position_rad: 2}"
BY_ELEMENT = "columns: {t_s: 'data[:,0]', torque_nm: 'data[:,1]', position_rad: 'data[:,2]'}"
BY_NAME = "columns: {t_s: Zeit, torque_nm: Moment, position_rad: {from: Winkel, unit: rad}}"


def read(folder: Path, name: str, content: bytes, mapped: str | None = None) -> Recording:
    (folder / name).write_bytes(content)
    if mapped is None:
        return load_recording(folder / name)
    (folder / "map.yaml").write_text(mapped)
    return load_recording(folder / name, folder / "map.yaml")


def require_same(recording: Recording) -> None:
    assert np.allclose(recording.t_s, T, atol=1e-12)
    assert np.allclose(recording.torque, U, atol=1e-12) and np.allclose(recording.position, X, atol=1e-12)


def lines(separator: str = ",", comma: bool = False, end: str = "\n", before: str = "", after: str = "") -> str:
    rows = (separator.join(f"{value:.6f}" for value in row) for row in TABLE)
    return "".join(before + (row.replace(".", ",") if comma else row) + after + end for row in rows)


TEXTS = {
    "no header": ("r.csv", lines(), BY_NUMBER),
    "no header, by element": ("r.csv", lines(), BY_ELEMENT),
    "blanks": ("r.txt", "  t_s   torque_nm position_rad\n" + lines("   ", before=" ", after="  "), None),
    "blanks and no header": ("r.txt", lines("  ", before="  "), BY_NUMBER),
    "tabs": ("r.txt", "t_s\ttorque_nm\tposition_rad\n" + lines("\t"), None),
    "commas in a .txt": ("r.txt", "t_s, torque_nm, position_rad\n" + lines(", "), None),
    "numpy's header": ("r.txt", "# t_s torque_nm position_rad\n" + lines(" "), None),
    "decimal commas between blanks": ("r.txt", lines(" ", comma=True), BY_NUMBER),
    "Excel": ("r.csv", "\ufeffZeit;Moment;Winkel;;\r\n" + lines(";", comma=True, end="\r\n", after=";;"), BY_NAME),
    "Excel without header": ("r.csv", lines(";", comma=True, after=";"), BY_NUMBER),
    "sep= and empty ends": ("r.csv", "sep=;\r\nZeit;Moment;Winkel\r\n" + lines(";", comma=True, after=";"), BY_NAME),
    "a header with more ends": ("r.csv", "Zeit,Moment,Winkel,,\n" + lines(), BY_NAME),
    "units beneath": ("r.csv", "Zeit;Moment;Winkel\ns;Nm;rad\n" + lines(";", comma=True), BY_NAME),
    "quoted": ("r.csv", '"Zeit","Moment","Winkel"\n' + lines('","', before='"', after='"'), BY_NAME),
    "separators in names": ("r.csv", '"Zeit","M, N","Winkel"\n' + lines(), BY_NAME.replace("Moment", "'M, N'")),
    "comments": ("r.csv", "# made by hand\n%\n\nt_s,torque_nm,position_rad\n" + lines(), None),
}  # fmt: skip


@pytest.mark.parametrize("case", TEXTS)
def test_text_as_people_write_it(case: str, tmp_path: Path) -> None:
    name, text, mapped = TEXTS[case]
    require_same(read(tmp_path, name, text.encode(), mapped))
    if name.endswith(".txt"):
        require_same(read(tmp_path, f"{name}.gz", gzip.compress(text.encode()), mapped))


def test_units_beneath_the_names_are_told_and_not_applied(tmp_path: Path) -> None:
    text = "Zeit;Moment;Winkel\nms;Nm;Grad\n" + lines(";", comma=True)
    recording = read(tmp_path, "r.csv", text.encode(), BY_NAME)
    assert "line 2 taken for units, not applied" in recording.report[0] and "ms;Nm;Grad" in recording.report[0]
    require_same(recording)


def test_text_of_windows_and_of_excel_in_two_octets(tmp_path: Path) -> None:
    head = "Zeit;Moment;Winkel [°]\n"
    mapped = BY_NAME.replace("Winkel", "'Winkel [°]'")
    recording = read(tmp_path, "r.csv", (head + lines(";", comma=True)).encode("cp1252"), mapped)
    assert "cp1252" in recording.report[0]
    require_same(recording)
    require_same(read(tmp_path, "r.txt", ("Zeit\tMoment\tWinkel\n" + lines("\t")).encode("utf-16"), BY_NAME))


def test_thousands_are_read_where_they_are_beyond_doubt(tmp_path: Path) -> None:
    def text(cells: list[str]) -> bytes:
        rows = zip(T, U, [*cells, *("1.000,5" for _ in T[len(cells) :])], strict=True)
        return ("t_s;torque_nm;position_rad\n" + "".join(f"{t};{u};{x}\n" for t, u, x in rows)).encode()

    assert np.allclose(read(tmp_path, "r.csv", text(["1.234.567,25", "-0,5"])).position[:2], [1234567.25, -0.5])
    quoted = b"t_s,torque_nm,position_rad\n" + b"".join(b'%f,0,"1,234"\n' % t for t in T)
    with pytest.raises(BadInput, match=r"column position_rad, row 1: found '1,234'; allowed: a number; this one may"):
        read(tmp_path, "r.csv", quoted)
    with pytest.raises(BadInput, match=r"row 3: found 'x'"):
        read(tmp_path, "r.csv", text(["1,5", "2,5", "x"]))


def test_a_column_that_begins_whole_goes_on_in_fractions(tmp_path: Path) -> None:
    """The first block of a long file has no fraction in it."""
    rows = "".join(f"{n}e-3,{0 if n < 90_000 else 0.5},{n * 1e-5}\n" for n in range(100_000))
    recording = read(tmp_path, "r.csv", ("t_s,torque_nm,position_rad\n" + rows).encode())
    assert recording.torque[0] == 0.0 and recording.torque[-1] == 0.5 and len(recording) == 100_000


def _npz(folder: Path, **arrays: np.ndarray) -> bytes:
    np.savez_compressed(folder / "made.npz", **arrays)
    return (folder / "made.npz").read_bytes()


def _npy(folder: Path, values: np.ndarray) -> bytes:
    np.save(folder / "made.npy", values)
    return (folder / "made.npy").read_bytes()


def _mat(folder: Path, **content: object) -> bytes:
    savemat(folder / "made.mat", content, do_compression=True)
    return (folder / "made.mat").read_bytes()


def test_columns_of_matrices(tmp_path: Path) -> None:
    require_same(read(tmp_path, "r.npy", _npy(tmp_path, TABLE), BY_ELEMENT))
    require_same(read(tmp_path, "r.npy", _npy(tmp_path, np.asfortranarray(TABLE)), BY_NUMBER))
    require_same(read(tmp_path, "r.npz", _npz(tmp_path, data=TABLE, more=U), BY_ELEMENT))
    require_same(read(tmp_path, "r.mat", _mat(tmp_path, data=TABLE, more=np.zeros((3, 4))), BY_ELEMENT))
    require_same(read(tmp_path, "r.mat", _mat(tmp_path, s={"data": TABLE}), BY_ELEMENT.replace("data", "s.data")))
    lying = "columns: {t_s: 'd[0,:]', torque_nm: 'd[1,:]', position_rad: 'd[2,:]'}"
    require_same(read(tmp_path, "r.npz", _npz(tmp_path, d=TABLE.T), lying))
    fields = np.rec.fromarrays([T, U, X], names="t_s,torque_nm,position_rad")
    require_same(read(tmp_path, "r.npy", _npy(tmp_path, fields)))
    require_same(read(tmp_path, "r.npz", _npz(tmp_path, t_s=T, torque_nm=U[:, None], position_rad=X)))


@pytest.mark.parametrize("kind", ["npz", "mat"])
def test_a_matrix_needs_a_column_that_it_has(kind: str, tmp_path: Path) -> None:
    content = (_npz if kind == "npz" else _mat)(tmp_path, data=TABLE)
    with pytest.raises(BadInput, match=r"column data: found 3 columns; allowed: up to data\[:,2\]"):
        read(tmp_path, f"r.{kind}", content, BY_ELEMENT.replace("2]", "3]"))
    with pytest.raises(BadInput, match=r"a matrix of 60 rows and 3 columns; allowed: from: data\[:,0\] to \[:,2\]"):
        read(tmp_path, f"r.{kind}", content, BY_ELEMENT.replace("'data[:,2]'", "data"))


def test_one_number_holds_for_all_rows(tmp_path: Path) -> None:
    mapped = "columns: {t_s: t_s, torque_nm: torque_nm, position_rad: position_rad, kp: gain}"
    for name, content in (
        ("r.npz", _npz(tmp_path, t_s=T, torque_nm=U, position_rad=X, gain=np.array(8.0))),
        ("r.mat", _mat(tmp_path, t_s=T, torque_nm=U, position_rad=X, gain=8.0)),
        ("r.json", json.dumps({"t_s": [*T], "torque_nm": [*U], "position_rad": [*X], "gain": 8}).encode()),
    ):
        gain = read(tmp_path, name, content, mapped).get(Quantity.GAIN)
        assert gain is not None and np.array_equal(gain, np.full(60, 8.0))


def test_records_of_json(tmp_path: Path) -> None:
    records = [{"time": t, "motor": {"torque": u, "joints": [0.0, x]}} for t, u, x in TABLE.tolist()]
    nested = "columns: {t_s: time, torque_nm: motor.torque, position_rad: 'motor.joints[:,1]'}"
    text = "\n".join(json.dumps(record) for record in records).encode()
    require_same(read(tmp_path, "r.json", json.dumps(records).encode(), nested))
    require_same(read(tmp_path, "r.jsonl", text + b"\n\n", nested.replace("[:,1]", "[1]")))
    require_same(read(tmp_path, "r.json", text, nested))
    require_same(read(tmp_path, "r.jsonl.gz", gzip.compress(text), nested))
    within = nested.replace("time", "log.rows.time").replace("motor.", "log.rows.motor.")
    require_same(read(tmp_path, "r.json", json.dumps({"log": {"rows": records}}).encode(), within))
    require_same(read(tmp_path, "r.json", json.dumps({"data": TABLE.tolist()}).encode(), BY_ELEMENT))
    del records[4]["motor"]
    held = read(tmp_path, "r.json", json.dumps(records).encode(), nested)
    assert not held.measured[4] and "missing cells" in " ".join(held.report)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("r.json", b'[{"t_s": 1,', "JSON: a list of objects"),
        ("r.json", b"[" * 100_000, "r.json: found"),
        ("r.json", b'[{"t_s": "x", "torque_nm": 1, "position_rad": 1}]', "column t_s, row 1: found 'x'"),
        ("r.jsonl", b'{"t_s": 1}\n{', "JSON"),
        ("r.npz", b"PK\5\6" + b"\0" * 10, "np.savez"),
        ("r.npy", b"\x93NUMPY\x01\x00\x04\x00{  \n", "np.save"),
        ("r.csv", b"\x00\x01\x02,\x00\n", "bytes that are no text"),
        ("r.csv", "\ufefft".encode("utf-16-le") + b"\x00\xd8\n", "UTF-16"),
    ],
)
def test_what_is_broken_is_named(name: str, content: bytes, said: str, tmp_path: Path) -> None:
    with pytest.raises(BadInput) as error:
        read(tmp_path, name, content)
    assert said in str(error.value) and str(tmp_path / name) in str(error.value)


def test_new_kinds_are_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(readers, "MOST_CELLS", 100)
    records = [dict(zip(("t_s", "torque_nm", "position_rad"), row, strict=True)) for row in TABLE.tolist()]
    for name, content, mapped in (
        ("r.npy", _npy(tmp_path, TABLE), BY_ELEMENT),
        ("r.npz", _npz(tmp_path, t_s=T, torque_nm=U, position_rad=X), None),
        ("r.mat", _mat(tmp_path, data=TABLE), BY_ELEMENT),
        ("r.json", json.dumps(records).encode(), None),
        ("r.jsonl", "\n".join(map(json.dumps, records)).encode(), None),
        ("r.txt", lines(" ").encode(), BY_NUMBER),
    ):
        with pytest.raises(BadInput, match=r"found \d+ rows or more .* at most 100 numbers"):
            read(tmp_path, name, content, mapped)


def test_an_array_that_claims_more_than_it_has_takes_no_memory(tmp_path: Path) -> None:
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (%d,), }\n"
    for count, said in ((2**40, "at most 60000000 numbers"), (50_000_000, "cut off")):
        text = header % count
        with pytest.raises(BadInput, match=said):
            read(tmp_path, "r.npy", b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text, BY_NUMBER)


def test_lists_in_cells(tmp_path: Path) -> None:
    """As LeRobot keeps its joints in Parquet, and SAGE in CSV."""
    mapped = "columns: {t_s: t, torque_nm: 'effort[1]', position_rad: 'state[:,2]'}"
    states = [[0.0, 1.0, x] for x in X.tolist()]
    efforts = [[0.0, u] for u in U.tolist()]
    for kind in (pa.list_(pa.float64()), pa.list_(pa.float64(), 3)):
        table = {"t": T, "effort": pa.array(efforts), "state": pa.array(states, kind)}
        pq.write_table(pa.table(table), tmp_path / "made.parquet")
        require_same(read(tmp_path, "r.parquet", (tmp_path / "made.parquet").read_bytes(), mapped))
    text = "t,effort,state\n" + "".join(
        f'{t},"{effort}","{state}"\n' for t, effort, state in zip(T, efforts, states, strict=True)
    )
    require_same(read(tmp_path, "r.csv", text.encode(), mapped))
    with pytest.raises(BadInput, match=r"column state, element 3"):
        read(tmp_path, "r.csv", text.encode(), mapped.replace("[:,2]", "[3]"))
    with pytest.raises(BadInput, match=r"column t, element 0|column t: found"):
        read(tmp_path, "r.csv", text.encode(), mapped.replace("t_s: t", "t_s: 't[0]'"))


JOINT_STATE = """std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""


def write_bag(path: Path, stop: int = len(T)) -> None:
    from mcap_ros2.writer import Writer

    with path.open("wb") as stream:
        writer = Writer(stream)
        schema = writer.register_msgdef("sensor_msgs/msg/JointState", JOINT_STATE)
        for n, (_, u, x) in enumerate(TABLE[:stop].tolist()):
            stamp = {"sec": 1700, "nanosec": n * 1_000_000}
            names, order = (["elbow", "wrist"], 1) if n % 2 else (["wrist", "elbow"], -1)  # in any order
            message = {
                "header": {"stamp": stamp, "frame_id": ""},
                "name": names,
                "position": [x, 7.0][::order],
                "velocity": [],
                "effort": [u, 7.0][::order],
            }
            writer.write_message("/joint_states", schema, message, n * 10**6, n * 10**6)
            other = {**message, "name": ["finger"], "position": [1.0], "effort": [0.0]}
            writer.write_message("/joint_states", schema, other, n * 10**6, n * 10**6)
            writer.write_message("/gripper_states", schema, other, n * 10**6, n * 10**6)
        writer.finish()


def test_joint_states_of_ros2(tmp_path: Path) -> None:
    mapped = tmp_path / "map.yaml"
    mapped.write_text("columns: {torque_nm: elbow.effort, position_rad: elbow.position}")
    write_bag(tmp_path / "bag.mcap")
    recording = load_recording(tmp_path / "bag.mcap", mapped)
    require_same(recording)
    assert "joint states on /joint_states are read, those on /gripper_states are not" in recording.report
    with pytest.raises(BadInput, match=r"column shoulder.effort: .* elbow.effort"):
        mapped.write_text("columns: {torque_nm: shoulder.effort, position_rad: elbow.position}")
        load_recording(tmp_path / "bag.mcap", mapped)
    with pytest.raises(BadInput, match=r"column torque_nm: found none \(columns: t_s, .*elbow.position"):
        load_recording(tmp_path / "bag.mcap")
