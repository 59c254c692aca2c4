"""`servoctl plot`, and the page on which every cycle can be looked at."""

from __future__ import annotations

import base64
import json
import re
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from servod.cli.app import run
from servod.cli.plot import draw_cycles
from servod.common.faults import FAULTS, FaultCode
from servod.formats.recording.mcap_writer import McapFile
from servod.formats.recording.record import FIELDS, RECORD, CycleRecord
from servod.lab.report.figure import Figure, PlotAxis, PlotPanel, curve
from servod.lab.report.figures.motion import RecordedRun, recorded_run
from servod.lab.report.page import MOST_BYTES, PageData, at_most
from servod.runtime.fieldbus.devices import DriveState
from servod.runtime.loop.axis import AxisState

ZERO = CycleRecord._make(0 if f.kind == "q" else 0.0 for f in FIELDS)
CYCLES = 20_000
FAULT = FAULTS[FaultCode.SPEED_LIMIT].bit


def cycle(k: int) -> bytes:
    """A sine of 20 Hz at 1 kHz that drops out in its last second."""
    t = 1e-3 * k
    dropped = k >= CYCLES - 1000
    return RECORD.pack(*ZERO._replace(
        time_ns=5_000_000_000 + k * 1_000_000, cycle=k, missed=int(k > 100),
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
    assert "missed periods: 1" in page
    t, reference = kept(page)[0]
    assert np.allclose(t, 1e-3 * np.arange(CYCLES))
    assert np.allclose(reference, 0.1 * np.sin(40.0 * np.pi * t), atol=1e-7)


def test_caption_and_verdict_tell_the_same_figures(recording: Path, tmp_path: Path) -> None:
    """Of a recording those of its rows; of a motion those of its tally, in both places."""
    page = tmp_path / "run.html"
    assert run(["plot", str(recording), "--out", str(page)]) == 0
    for expected in (
        r"20000 cycles .*; RMS error .* largest .*; SPEED_LIMIT first at 19\.000 s\.",
        r"motion done: RMS 1 mrad\.",
    ):
        text = page.read_text()
        (verdict,), (caption,) = re.findall(r'id="verdict".*?>(.*?)</p>', text), re.findall(r"<figcaption>(.*?)<", text)
        assert re.fullmatch(expected, caption) and verdict.removesuffix(".") == caption.removesuffix(".")
        draw_cycles(cycle(0) + cycle(1), "servoctl track sine", page, ["motion done: RMS 1 mrad"])


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
        (0.0, 0), (0.002, 0), (0.002, 1), (0.005, 1), (0.005, 2), (0.009, 2), (0.009, 6),
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


def test_a_curve_that_is_too_long_keeps_its_peaks() -> None:
    y = np.sin(np.arange(100_000) * 0.4)
    y[54_321] = 7.0
    x, kept_y = at_most(np.arange(100_000.0), y, 2000)
    assert len(x) <= 2001 and np.all(np.diff(x) > 0)
    assert kept_y.max() == 7.0 and x[np.argmax(kept_y)] == 54_321
