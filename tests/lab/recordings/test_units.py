"""Units of foreign columns, and the maps that come with servod."""

from __future__ import annotations

import gzip
import json
import math
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from servod.common.errors import BadInput
from servod.lab.recordings import Quantity, Recording, load_recording
from servod.lab.recordings.columns import SHIPPED, load_column_map, shipped_maps

T = np.arange(60.0)


def read(folder: Path, columns: str, text: str | None = None) -> Recording:
    (folder / "map.yaml").write_text(f"columns: {{{columns}}}")
    (folder / "r.csv").write_text(text or "a,b,c\n" + "".join(f"{t},{3 + t % 5},{2 * t}\n" for t in T))
    return load_recording(folder / "r.csv", folder / "map.yaml")


@pytest.mark.parametrize(
    ("column", "source", "factor"),
    [
        ("position_rad", "unit: deg", math.pi / 180),
        ("position_rad", "unit: °", math.pi / 180),
        ("position_rad", "unit: counts, counts_per_turn: 4096", 2 * math.pi / 4096),
        ("velocity_rad_s", "unit: rpm", 2 * math.pi / 60),
        ("velocity_rad_s", "unit: counts/s, counts_per_turn: 100", 2 * math.pi / 100),
        ("torque_nm", "unit: mNm", 1e-3),
        ("torque_nm", "unit: N·m", 1.0),
        ("torque_nm", "unit: oz*in", 0.00706155181),
        ("torque_nm", "unit: lbf*ft", 1.3558179483),
        ("torque_nm", "unit: mA, scale: 0.05", 5e-5),
        ("torque_nm", "unit: '%', scale: 2.5", 0.025),
        ("current_a", "unit: mA", 1e-3),
        ("voltage_v", "unit: mV", 1e-3),
        ("supply_v", "unit: V", 1.0),
        ("duty", "unit: permille", 1e-3),
        ("load_position_rad", "unit: arcmin", math.pi / 180 / 60),
    ],
)
def test_a_unit_scales_to_si(column: str, source: str, factor: float, tmp_path: Path) -> None:
    needed = {"t_s": "{from: a, unit: ms}", "torque_nm": "b", "position_rad": "b"}
    mapped = ", ".join(f"{name}: {told}" for name, told in (needed | {column: f"{{from: c, {source}}}"}).items())
    recording = read(tmp_path, mapped)
    (quantity,) = (q for q in Quantity if column in q.value)
    found = recording.get(quantity)
    assert found is not None and np.allclose(found, 2.0 * T * factor, rtol=1e-8)
    assert np.allclose(recording.t_s, 1e-3 * T)


def test_units_of_a_linear_axis_and_of_temperature(tmp_path: Path) -> None:
    mapped = (
        "t_s: {from: a, unit: us, scale: 1000}, force_n: {from: b, unit: lb}, position_m: {from: c, unit: inch}, "
        "temperature_c: {from: b, unit: °F}, velocity_m_s: {from: c, unit: mm/min}, "
        "reference_m: {from: c, unit: deg, scale: 0.01, offset: 0.5}"
    )
    found = read(tmp_path, mapped)
    assert np.allclose(found.t_s, 1e-3 * T) and np.allclose(found.torque, (3 + T % 5) * 4.4482216152605)
    assert np.allclose(found.position, 2 * T * 0.0254)
    assert np.allclose(found.columns[Quantity.TEMPERATURE], (3 + T % 5 - 32) * 5 / 9)
    assert np.allclose(found.columns[Quantity.VELOCITY], 2 * T / 60e3)
    assert np.allclose(found.columns[Quantity.REFERENCE], 2 * T * math.pi / 180 * 0.01 + 0.5)
    kelvin = read(tmp_path, "t_s: {from: a, unit: s}, force_n: b, position_m: b, temperature_c: {from: c, unit: K}")
    assert np.allclose(kelvin.columns[Quantity.TEMPERATURE], 2 * T - 273.15)


@pytest.mark.parametrize(
    ("source", "key", "found", "allowed"),
    [
        ("position_rad: {from: c, unit: degs}", "position_rad.unit", "degs", "rad, mrad, urad, deg"),
        ("position_rad: {from: c, unit: A}", "position_rad.unit", "A", "counts"),
        ("torque_nm: {from: b, unit: mA}", "torque_nm.unit", "mA", "mA with scale: N*m for each A"),
        ("t_s: {from: a, unit: m}", "t_s.unit", "m", "s, ms, us"),
        ("kp: {from: c, unit: deg}", "kp.unit", "deg", "1"),
        ("position_rad: {from: c, unit: counts}", "position_rad.counts_per_turn", "none", "counts of one turn"),
        ("position_rad: {from: c, counts_per_turn: 9}", "position_rad.counts_per_turn", "9.0", "only with unit counts"),
        ("position_rad: {from: c, unit: counts, counts_per_turn: 0}", "counts_per_turn", "0", "greater than 0"),
        ("position_rad: {unit: deg}", "position_rad", "", "one of from and from_name"),
        ("position_rad: {from: -1}", "position_rad", "-1", ""),
    ],
)
def test_a_wrong_unit_gets_one_line(source: str, key: str, found: str, allowed: str, tmp_path: Path) -> None:
    with pytest.raises(BadInput) as error:
        plain = {"t_s": "a", "torque_nm": "b"}
        read(tmp_path, ", ".join([source, *(f"{k}: {v}" for k, v in plain.items() if not source.startswith(k))]))
    said = str(error.value)
    assert said.startswith(f"{tmp_path / 'map.yaml'}: columns.") and "\n" not in said
    assert all(word in said for word in (key, found, allowed))


def test_a_goal_position_is_a_command_as_well(tmp_path: Path) -> None:
    """Read without a torque; what needs one says so in one line."""
    recording = read(tmp_path, "t_s: {from: a, unit: ms}, position_rad: b, reference_rad: c")
    assert np.array_equal(recording.columns[Quantity.REFERENCE], 2 * T)
    said = r"column torque_nm: found none \(there is reference_rad\); allowed: torque_nm; a --map file makes it"
    for use in (lambda: recording.torque, lambda: recording.drive):
        with pytest.raises(BadInput, match=said):
            use()
    with pytest.raises(BadInput, match=r"column torque_nm: .* without a torque one of reference_rad, voltage_v, duty"):
        read(tmp_path, "t_s: {from: a, unit: ms}, position_rad: b")


def test_shipped_maps_are_good_maps() -> None:
    assert shipped_maps() == ("bam", "bam_json", "kscale", "lerobot", "pace", "sage")
    for name in shipped_maps():
        assert {"t_s", "position_rad"} <= set(load_column_map(Path(name)))
        assert (SHIPPED / f"{name}.yaml").read_text().startswith("# ")


def _table(header: str, *columns: np.ndarray) -> bytes:
    rows = (",".join(map(repr, row)) for row in np.column_stack(columns).tolist())
    return gzip.compress("\n".join([header, *rows]).encode())


def test_layouts_as_people_publish_them(tmp_path: Path) -> None:
    t_s, x, goal = 0.01 * T, np.sin(0.1 * T), np.sin(0.1 * T + 0.2)
    kscale = tmp_path / "m0.969_sin_sin_kp16_r1.csv.gz"
    header = "timestamp,duty,position,goal_position,speed,input_volts,temp,current,load"
    kscale.write_bytes(_table(header, t_s, goal - x, x, goal, x, 11.9 + 0 * x, 33 + 0 * x, x, x))
    read_kscale = load_recording(kscale, "kscale")
    assert np.allclose(read_kscale.torque, 10.0 * (goal - x)) and set(read_kscale.columns[Quantity.GAIN]) == {16.0}
    assert np.allclose(read_kscale.columns[Quantity.REFERENCE], goal)
    bam = tmp_path / "sin_sin_kp400.csv.gz"
    header = "t_s,voltage_command_v,position_rad,velocity_rad_s,reference_rad,load_raw,supply_v,temperature_c"
    bam.write_bytes(_table(header, t_s, goal, x, x, goal, x, 7.3 + 0 * x, 30 + 0 * x))
    read_bam = load_recording(bam, "bam")
    assert np.allclose(read_bam.torque, 0.08 * goal) and set(read_bam.columns[Quantity.GAIN]) == {400.0}
    entries = [{"timestamp": t, "position": a, "goal_position": b} for t, a, b in zip(t_s, x, goal, strict=True)]
    (tmp_path / "log.json").write_text(json.dumps({"kp": 32, "motor": "xl330", "entries": entries}))
    read_json = load_recording(tmp_path / "log.json", "bam_json")
    assert np.allclose(read_json.position, x) and set(read_json.columns[Quantity.GAIN]) == {32.0}
    state = pa.array(np.degrees(np.column_stack([x, x])).tolist(), pa.list_(pa.float32(), 2))
    action = pa.array(np.degrees(np.column_stack([goal, x])).tolist(), pa.list_(pa.float32(), 2))
    pq.write_table(pa.table({"observation.state": state, "action": action, "timestamp": t_s}), tmp_path / "e.parquet")
    read_lerobot = load_recording(tmp_path / "e.parquet", "lerobot")
    assert np.allclose(read_lerobot.position, x, atol=1e-6)
    assert np.allclose(read_lerobot.columns[Quantity.REFERENCE], goal, atol=1e-6)
    cells = (
        f'STATE_MOTOR,{1e6 * t},"[{a}, 0.0]","[{a}, 0.0]","[{b}, 0.0]"' for t, a, b in zip(t_s, x, goal, strict=True)
    )
    (tmp_path / "state_motor.csv").write_text("\n".join(["type,timestamp,positions,velocities,torques", *cells]))
    read_sage = load_recording(tmp_path / "state_motor.csv", "sage")
    assert np.allclose(read_sage.t_s, t_s) and np.allclose(read_sage.torque, goal)
    np.savez(tmp_path / "chirp.npz", time=t_s, dof_pos=np.column_stack([x, x]), des_dof_pos=np.column_stack([goal, x]))
    read_pace = load_recording(tmp_path / "chirp.npz", "pace")
    assert np.allclose(read_pace.position, x) and np.allclose(read_pace.columns[Quantity.REFERENCE], goal)


def test_a_gain_that_the_name_does_not_tell(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=r"r.csv: file's name: found no number; allowed: a number behind '_kp'"):
        read(tmp_path, "t_s: a, torque_nm: b, position_rad: c, kp: {from_name: _kp}")
