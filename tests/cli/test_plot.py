"""`servoctl plot`, and the page on which every cycle can be looked at."""

from __future__ import annotations

import base64
import hashlib
import json
import os
import re
import subprocess
import sys
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from servod.cli.app import run
from servod.cli.plot import draw_cycles
from servod.common.faults import FAULTS, FaultCode
from servod.common.shipped import shipped
from servod.formats.recording.mcap_writer import McapFile
from servod.formats.recording.record import FIELDS, RECORD, CycleRecord
from servod.lab.report.figure import Figure, PlotAxis, PlotPanel, curve, thin
from servod.lab.report.figures.motion import RecordedRun, recorded_run
from servod.lab.report.page import MOST_BYTES, PageData
from servod.runtime.fieldbus.devices import DriveState
from servod.runtime.loop.axis_state import AxisState

ZERO = CycleRecord._make(0 if f.kind == "q" else 0.0 for f in FIELDS)
CYCLES = 20_000
FAULT = FAULTS[FaultCode.SPEED_LIMIT].bit


def cycle(k: int) -> bytes:
    """A sine of 20 Hz at 1 kHz that drops out in its last second."""
    t = 1e-3 * k
    dropped = k >= CYCLES - 1000
    return RECORD.pack(*ZERO._replace(
        time_ns=5_000_000_000 + k * 1_000_000, cycle=k + int(k > 100), missed=int(k > 100),
        axis_state=AxisState.FAULT if dropped else AxisState.ENABLED,
        drive_state=DriveState.FAULT if dropped else DriveState.OPERATION_ENABLED,
        faults=FAULT if CYCLES - 1000 <= k < CYCLES - 500 else 0,
        reference_rad=0.1 * np.sin(40.0 * np.pi * t), position_rad=0.1 * np.sin(40.0 * np.pi * (t - 1e-3)),
        torque_nm=0.2 * np.cos(40.0 * np.pi * t), torque_feedback_nm=0.1,
    ))  # fmt: skip


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twenty seconds."""
    path = tmp_path_factory.mktemp("plot") / "run.mcap"
    file = McapFile(path, {}, 0)
    file.write_rows([cycle(k) for k in range(CYCLES)])
    file.write_event({"time_ns": 24_000_000_000, "kind": "fault", "text": "too fast <b>"})
    file.close()
    return path


def kept(page: str) -> list[tuple[np.ndarray, np.ndarray]]:
    """Time and value of every curve, as the page keeps them."""
    found = re.search(r'id="page-data">(.*?)</script>', page)
    assert found
    document = json.loads(found[1])
    curves = [curve for figure in document["figures"] for panel in figure["panels"] for curve in panel["curves"]]
    return [(unpacked(document["arrays"][c["x"]]), unpacked(document["arrays"][c["y"]])) for c in curves]


def unpacked(array: dict[str, Any]) -> np.ndarray:
    """Rows from their packed form: an even grid by its numbers, or bytes by their place."""
    if "z" not in array:
        return array["from"] + array["step"] * np.arange(array["n"])
    size = int(array["kind"][1])
    raw = np.frombuffer(zlib.decompress(base64.b64decode(array["z"])), np.uint8).reshape(size, -1)
    return np.ascontiguousarray(raw.T).view(f"<{array['kind']}").ravel()


def test_a_page_and_a_picture(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(["plot", str(recording)]) == 0
    assert capsys.readouterr().out == "drawn: run.html\ndrawn: run.png\n"
    assert Path("run.png").read_bytes().startswith(b"\x89PNG")
    page = Path("run.html").read_text()
    assert "SPEED_LIMIT" in page and "OPERATION_ENABLED" in page and "state feedback" in page
    assert "too fast &lt;b&gt;" in page and "19.000" in page
    assert "missing samples: 1;" in page
    t, reference = kept(page)[0]
    assert np.allclose(t, 1e-3 * np.arange(CYCLES))
    assert np.allclose(reference, 0.1 * np.sin(40.0 * np.pi * t), atol=1e-7)


def verdict(page: Path) -> str:
    """The first sentence of a page; its caption must be the same."""
    text = page.read_text()
    (said,), (caption,) = re.findall(r'id="verdict".*?>(.*?)</p>', text), re.findall(r"<figcaption>(.*?)<", text)
    assert said.removesuffix(".") == caption.removesuffix(".")
    return str(said)


def written(path: Path, rows: list[CycleRecord], attachments: dict[str, bytes] | None = None) -> Path:
    """A recording of these cycles."""
    file = McapFile(path, attachments or {}, 0)
    file.write_rows([RECORD.pack(*row) for row in rows])
    file.close()
    return path


def moved(k: int, **changes: Any) -> CycleRecord:
    """A cycle of an enabled axis with an error of a milliradian."""
    at = {"time_ns": 1_000_000 * k, "cycle": k, "axis_state": AxisState.ENABLED, "reference_rad": 0.001}
    return ZERO._replace(**at | changes)


@pytest.mark.parametrize(("cut", "says"), [(-4000, "the file is cut off: "), (0, "the file is damaged: ")])
def test_the_page_of_a_damaged_recording_says_what_is_missing(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], cut: int, says: str
) -> None:
    """Torn, or with a bit that turned in its middle: in the first words of the page and on the terminal."""
    data = bytearray(recording.read_bytes())
    data[len(data) // 2] ^= 1
    bent, page = tmp_path / "bent.mcap", tmp_path / "bent.html"
    bent.write_bytes(recording.read_bytes()[:cut] if cut else data)
    assert run(["plot", str(bent), "--out", str(page)]) == 0
    found = re.search(rf"Incomplete: {says}(\d+) .*, from the first \d+ of {len(data) + cut} bytes; ", verdict(page))
    assert found and 0 < int(found[1]) <= CYCLES and "bent.mcap (incomplete)" in page.read_text()
    assert says in capsys.readouterr().out
    assert hashlib.sha256(bent.read_bytes()).hexdigest() in page.read_text()


def test_samples_that_are_no_number_are_counted_and_the_rest_is_judged(tmp_path: Path) -> None:
    """In the daemon's recording as in its export; each gain set by its name, where two ran."""
    names = ("demo_pd", "demo_pd_dob")
    texts = [shipped(f"gains/{name}.yaml").read_bytes() for name in names]
    file = McapFile(tmp_path / "a.mcap", {"gains.yaml": texts[0]}, 0)
    bent = {5: np.inf, 400: np.nan, 401: 1e300}
    rows = [moved(k, controller=int(k >= 300), position_rad=bent.get(k, 0.0)) for k in range(600)]
    file.write_rows([RECORD.pack(*row) for row in rows])
    file.attach("gains.yaml", texts[1])
    file.close()
    told, page = [], tmp_path / "a.html"
    for kind in ("mcap", "csv", "parquet"):
        if kind != "mcap":
            assert run(["record", "export", str(tmp_path / "a.mcap"), "--out", str(tmp_path / f"a.{kind}")]) == 0
        assert run(["plot", str(tmp_path / f"a.{kind}"), "--out", str(page)]) == 0
        told.append(verdict(page))
        if kind == "mcap":
            hashes = [hashlib.sha256(text).hexdigest() for text in texts]
            ran = "; then ".join(f"{name}, sha256 {one}" for name, one in zip(names, hashes, strict=True))
            assert f"<dt>gain set</dt><dd>{ran}</dd>" in page.read_text()
    error = (
        "RMS error 1 mrad, largest 1 mrad ({} of 300 cycles, which have no error, left out) under gain set {} of this"
    )
    assert all(f"{error.format(n, k)} run ({names[k]})" in told[0] for k, n in ((0, 1), (1, 2)))
    assert told[1] == told[2] == told[0].replace(" (demo_pd)", "").replace(" (demo_pd_dob)", "")
    assert told[0].endswith("no fault present.")
    nothing = written(tmp_path / "b.mcap", [moved(k, position_rad=np.nan) for k in range(50)])
    assert run(["plot", str(nothing), "--out", str(tmp_path / "b.html")]) == 0
    assert "no error can be told, 50 cycles have none" in verdict(tmp_path / "b.html")


def test_an_export_is_judged_as_its_recording(recording: Path, tmp_path: Path) -> None:
    csv, pages = tmp_path / "run.csv", [tmp_path / "a.html", tmp_path / "b.html"]
    assert run(["record", "export", str(recording), "--out", str(csv)]) == 0
    for file, page in zip((recording, csv), pages, strict=True):
        assert run(["plot", str(file), "--out", str(page)]) == 0
    assert verdict(pages[0]) == verdict(pages[1]) and "SPEED_LIMIT first at t = 19.000 s" in verdict(pages[1])
    assert "OPERATION_ENABLED" in pages[1].read_text()


def test_the_page_of_a_recording_has_the_drives_that_it_tells(tmp_path: Path) -> None:
    attached = {"config.yaml": shipped("gains/config/can0.yaml").read_bytes(), "gains.yaml": b"of another version: 1"}
    path = written(tmp_path / "a.mcap", [moved(k) for k in range(20)], attached)
    assert run(["plot", str(path), "--out", str(tmp_path / "a.html")]) == 0
    text = (tmp_path / "a.html").read_text()
    assert text.count("<dt>drive</dt>") == 2 and "amplifier, node " in text and "<dt>gain set</dt>" not in text


def test_events_beyond_the_list_are_counted_and_a_part_has_its_own(tmp_path: Path) -> None:
    path, page = tmp_path / "a.mcap", tmp_path / "a.html"
    file = McapFile(path, {}, 0)
    file.write_rows([RECORD.pack(*moved(k)) for k in range(1000)])
    for k in range(700):
        file.write_event({"time_ns": 1_000_000 * k, "kind": "command", "text": f"order {k}."})
    file.close()
    assert run(["plot", str(path), "--out", str(page)]) == 0
    assert "order 499." in page.read_text() and "order 500." not in page.read_text()
    assert "200 more events are not listed" in page.read_text()
    assert run(["plot", str(path), "--from-s", "0.6", "--out", str(page)]) == 0
    assert "order 600." in page.read_text() and "order 699." in page.read_text()
    assert "order 599." not in page.read_text() and "not listed" not in page.read_text()


def test_a_name_in_latin_1_is_drawn(recording: Path, tmp_path: Path) -> None:
    name = os.fsdecode(b"caf\xe9.mcap")
    (tmp_path / name).write_bytes(recording.read_bytes())
    command = [sys.executable, "-m", "servod.cli", "plot", name]
    done = subprocess.run(command, capture_output=True, check=False, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, b"")
    assert {os.fsencode(file.name) for file in tmp_path.iterdir()} == {
        b"caf\xe9.mcap", b"caf\xe9.html", b"caf\xe9.png",
    }  # fmt: skip
    assert "<title>caf\\udce9.mcap</title>" in (tmp_path / os.fsdecode(b"caf\xe9.html")).read_text()


def test_plot_and_replay_miss_the_same_samples(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Nine skipped periods, and cycles that began 0.6 ms late, after which nothing is missing: nine, exported too."""
    skipped, late = [*range(100, 1000, 100)], {99, 150, 151, 350}
    numbers = [k for k in range(1200) if k not in skipped]
    path = tmp_path / "late.mcap"
    file = McapFile(path, {}, 0)
    for k in numbers:
        missed = sum(one < k for one in skipped)
        time_ns = 1_000_000 * k + (600_000 if k in late or k - 1 in skipped else 0)
        file.write_rows([RECORD.pack(*ZERO._replace(time_ns=time_ns, cycle=k, missed=missed))])
    file.close()
    assert run(["plot", str(path), "--out", str(tmp_path / "late.html")]) == 0
    assert "missing samples: 9;" in (tmp_path / "late.html").read_text()
    csv, model = tmp_path / "late.csv", str(shipped("gains/axes/demo_joint.yaml"))
    assert run(["record", "export", str(path), "--out", str(csv)]) == 0
    capsys.readouterr()
    for recording in (path, csv):
        assert run(["replay", "--model", model, str(recording), "--horizon", "0.25", "--json"]) == 0
        report = json.loads(capsys.readouterr().out)["report"]
        assert any("t_s: 9 gaps, about 9 samples missing" in line for line in report)


def test_caption_and_verdict_tell_the_same_figures(recording: Path, tmp_path: Path) -> None:
    """Of a recording those of its rows; of a motion those of its tally, in both places."""
    page = tmp_path / "run.html"
    assert run(["plot", str(recording), "--out", str(page)]) == 0
    for expected in (
        r"20000 cycles .*; RMS error .* largest .*; SPEED_LIMIT first at t = 19\.000 s\.",
        r"motion done: RMS 1 mrad\.",
    ):
        text = page.read_text()
        (verdict,), (caption,) = re.findall(r'id="verdict".*?>(.*?)</p>', text), re.findall(r"<figcaption>(.*?)<", text)
        assert re.fullmatch(expected, caption) and verdict.removesuffix(".") == caption.removesuffix(".")
        draw_cycles(cycle(0) + cycle(1), "servoctl track sine", page, ["motion done: RMS 1 mrad"])
    assert "<dt>recorded</dt>" in page.read_text()


def test_a_part_is_drawn_with_every_row(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "part.html"
    words = ["plot", str(recording), "--from-s", "2", "--to-s", "2.1", "--out", str(out), "--json"]
    assert run(words) == 0
    document = json.loads(capsys.readouterr().out)
    assert (document["rows"], document["from_s"], document["files"]) == (100, 2.0, [str(out)])
    assert not (tmp_path / "part.png").exists()


def test_a_foreign_recording_has_its_columns(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = tmp_path / "run.csv"
    rows = "".join(f"{k * 0.01:.2f},{0.1 * k},{0.01 * k},{0.011 * k}\n" for k in range(50))
    table.write_text("t_s,force_n,position_m,reference_m\n" + rows)
    assert run(["plot", str(table), "--out", str(tmp_path / "run.html")]) == 0
    assert capsys.readouterr().out == f"drawn: {tmp_path / 'run.html'}\n"
    page = (tmp_path / "run.html").read_text()
    assert "force in N" in page and "error in mm" in page


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--out", "run.pdf"], ".html (a page) or .png (a picture)"),
        (["--out", "/proc/nowhere/run.png"], "/proc/nowhere"),
        (["--from-s", "100", "--out", "run.png"], "0 to 19.999 s"),
    ],
)
def test_what_cannot_be_drawn_is_one_line(
    words: list[str], says: str, recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    assert run(["plot", str(recording), *words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert says in line


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--no-wait", "--plot", "motion.png"], "what has not run cannot be drawn"),
        (["--plot", "motion.pdf"], ".html (a page) or .png (a picture)"),
        (["--plot", "/proc/nowhere/motion.png"], "/proc/nowhere"),
        (["--duration", "601", "--plot", "motion.png"], "at most 600 s; a longer one is drawn from its recording"),
    ],
)
def test_a_motion_that_could_not_be_drawn_does_not_begin(
    words: list[str], says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    motion = ["track", "sine", "--amplitude", "0.1", "--frequency", "1"]
    motion += [] if "--duration" in words else ["--duration", "1"]
    assert run([*motion, *words, "--socket", "/nowhere/axis.sock"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert says in line


def test_states_jump_and_a_fault_of_one_cycle_is_seen() -> None:
    t = np.arange(10) * 1e-3
    faults = np.where(np.arange(10) == 4, FAULT, 0)
    state = np.array([0, 0, 1, 1, 1, 2, 2, 2, 2, 6])
    columns = {"position_rad": t, "torque_nm": t, "axis_state": state, "faults": faults}
    names = tuple(s.name for s in AxisState)
    figure = recorded_run(RecordedRun("run", t, columns, (("axis_state", "axis", names),)))
    shown, fault = figure.panels[-2].curves[0], figure.panels[-1].curves[0]
    corners = list(zip(shown.x.round(6).tolist(), shown.y.tolist(), strict=True))
    assert [c for k, c in enumerate(corners) if k == 0 or c != corners[k - 1]] == [
        (0.0, 0), (0.002, 0), (0.002, 1), (0.005, 1), (0.005, 2), (0.009, 2), (0.009, 3),
    ]  # fmt: skip
    assert fault.x[0] == pytest.approx(4e-3) and fault.x[1] == pytest.approx(5e-3)
    assert figure.panels[-1].y.names == ("SPEED_LIMIT",)
    assert {panel.x.span for panel in figure.panels} == {(0.0, float(t[-1]))}


def test_a_series_that_many_curves_show_is_kept_once() -> None:
    t = np.arange(3000) * 1e-3
    figure = recorded_run(RecordedRun("run", t, {"position_rad": t, "reference_rad": 2 * t, "torque_nm": 2 * t}))
    document = PageData([figure, figure]).document()
    assert len(document["arrays"]) == len({json.dumps(a) for a in document["arrays"]}) < len(figure.panels) * 2 + 1


def test_rows_of_a_page_have_a_bound() -> None:
    """Twenty curves of ten minutes at 1 kHz are thinned alike until they fit."""
    noise = np.random.default_rng(1).normal(size=600_000)
    curves = tuple(curve("", np.arange(600_000.0), noise + k) for k in range(20))
    figure = Figure("long", "long", (PlotPanel(PlotAxis("time in s"), PlotAxis("y"), curves),))
    data = PageData([figure])
    held = sum(len(unpacked(a)) * 4 for a in data.document()["arrays"] if a.get("kind") == "f4")
    assert held <= MOST_BYTES and 4000 < data.most_rows < 600_000


@pytest.mark.parametrize("peak", [0, 54_321, 99_900, 99_999])
def test_a_curve_that_is_too_long_keeps_its_peaks(peak: int) -> None:
    """Wherever they are, and what is no number beside them; bounds are thinned with their curve."""
    x = np.arange(100_000.0)
    y = np.sin(x * 0.4)
    y[peak], y[54_300], y[99_950:99_960] = 7.0, -6.0, np.nan
    kept_x, kept_y = thin(x, y, 1999)
    assert len(kept_x) <= 1999 and np.all(np.diff(kept_x) > 0)
    assert (np.nanmax(kept_y), kept_x[np.nanargmax(kept_y)], np.nanmin(kept_y)) == (7.0, peak, -6.0)
    assert (kept_x[0], kept_x[-1]) == (0.0, 99_999.0) and np.isnan(kept_y).any()
    long = np.arange(700_000.0)
    banded = curve("", long, np.sin(long), bounds=(np.sin(long) - 1.0, np.sin(long) + 1.0))
    (drawn,) = PageData([Figure("a", "a", (PlotPanel(PlotAxis("x"), PlotAxis("y"), (banded,)),))])._figures[0]["panels"]
    document = PageData([Figure("a", "a", (PlotPanel(PlotAxis("x"), PlotAxis("y"), (banded,)),))]).document()
    lengths = {len(unpacked(document["arrays"][drawn["curves"][0][key]])) for key in ("x", "y", "low", "high")}
    assert len(lengths) == 1
