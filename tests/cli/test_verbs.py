"""The verbs against a running daemon and virtual axis, as a user types them."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import pty
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from servod.cli.app import run
from servod.client.control import ControlClient
from servod.client.processes import child, running_axis, wait_until
from servod.formats.config import ControlConfig
from servod.formats.recording.mcap_reader import read_recording
from servod.lab.recordings.recording import moving, rows_of
from servod.lab.tracking.metrics import score
from servod.qualify.demo.axis import demo_config, gains_file, plant_file
from tests.cli.test_plot import kept
from tests.runtime.daemon.running import SharedAxis
from tests.starved import LOGS

pytestmark = pytest.mark.serial


@contextlib.contextmanager
def begun(folder: Path) -> Iterator[ControlConfig]:
    """A daemon on a virtual axis; recordings lie in `recordings` beside its socket."""
    config = demo_config(folder, folder / "recordings")
    LOGS.append(folder / "servod.log")
    with running_axis(config, plant_file(None), folder):
        yield config.control


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SharedAxis[ControlConfig]]:
    with contextlib.closing(SharedAxis(lambda: begun(tmp_path_factory.mktemp("axis")))) as found:
        yield found


@pytest.fixture
def axis(shared: SharedAxis[ControlConfig]) -> Path:
    """The control socket of a daemon on a virtual axis."""
    return shared.stands().socket


class Servoctl:
    """Types commands and reads what they print."""

    def __init__(self, socket: Path, capsys: pytest.CaptureFixture[str]) -> None:
        self.socket, self._capsys = socket, capsys

    def __call__(self, *words: str, code: int = 0) -> str:
        """Standard output, or the one line on standard error when it shall fail."""
        assert run([*words, "--socket", str(self.socket)]) == code, self._capsys.readouterr().err
        captured = self._capsys.readouterr()
        if code == 0:
            assert captured.err == ""
            return captured.out
        assert (captured.out, len(captured.err.splitlines())) == ("", 1)
        return captured.err

    def json(self, *words: str) -> dict[str, Any]:
        """The one JSON document."""
        document: dict[str, Any] = json.loads(self(*words, "--json"))
        return document

    @property
    def state(self) -> str:
        """State of the axis."""
        return str(self.json("status")["axis"]["state"])


@pytest.fixture
def servoctl(axis: Path, capsys: pytest.CaptureFixture[str]) -> Iterator[Servoctl]:
    """On an axis that is disabled and not recorded, whatever an earlier test left, and is disabled after."""
    tool = Servoctl(axis, capsys)
    if tool.state == "FAULT":
        tool("enable", "--reset-fault")
    run(["record", "stop", "--socket", str(axis)])
    capsys.readouterr()
    tool("disable")
    yield tool
    tool("disable")


def test_enable_move_and_disable(servoctl: Servoctl) -> None:
    assert servoctl.state == "DISABLED"
    told = servoctl("enable")
    assert told.startswith("enabled\n")
    assert ("\nwarning: stopping: not computed" in told) is (servoctl.json("status")["stopping"] is None) is True
    told = servoctl("track", "sine", "--amplitude", "0.02", "--frequency", "2", "--duration", "0.5").splitlines()
    assert re.fullmatch(r"motion done: RMS error \S+ mrad, peak error \S+ mrad", told[0])
    assert re.match(r"settling time \d\.\d{3} s after the reference had come to rest, to 0\.8 mrad \(2 % of", told[1])
    counted = re.fullmatch(r"peak torque \S+ N\*m; (\d+) of (\d+) cycles missed", told[2])
    assert counted and len(told) == 3
    missed, cycles = map(int, counted.groups())
    assert 499 <= cycles <= 501 + missed  # a motion ends with the first cycle that is run after its time
    assert servoctl.state == "ENABLED"
    assert servoctl("disable") == "disabled\n"
    assert servoctl.state == "DISABLED"


def test_the_figures_of_a_motion_are_those_of_its_recording(servoctl: Servoctl) -> None:
    servoctl("enable")
    path = servoctl.json("record", "start")["path"]
    found = servoctl.json("track", "paper", "--duration", "3")["figures"]
    servoctl("record", "stop")
    rows = moving(rows_of(read_recording(path).rows))
    error_mrad = 1e3 * (rows["reference_rad"] - rows["position_rad"])
    expected = score(1e-9 * (rows["time_ns"] - rows["time_ns"][0]), error_mrad)
    assert found["rms_error_mrad"] == pytest.approx(expected.rms_error_mrad, rel=1e-2)  # the last cycle is not moving
    assert found["max_error_mrad"] == pytest.approx(expected.max_error_mrad, rel=1e-2)
    assert found["peak_torque_nm"] == pytest.approx(float(np.abs(rows["torque_nm"]).max()), rel=1e-2)
    assert found["missed_cycles"] == rows["missed"][-1] - rows["missed"][0]
    assert (found["judged_from_s"], found["lost_cycles"]) == (1.0, 0)
    assert found["watched_s"] >= 0.5


def test_a_motion_that_is_broken_off_says_how_it_was_until_then(
    servoctl: Servoctl, axis: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    servoctl("enable")
    page, stopper = tmp_path / "motion.html", [sys.executable, "-m", "servod.cli", "stop", "--socket", str(axis)]
    stopping: list[subprocess.Popen[bytes]] = []
    stop = threading.Timer(1.5, lambda: stopping.append(subprocess.Popen(stopper)))
    stop.start()
    words = ("sine", "--amplitude", "0.02", "--frequency", "1", "--duration", "30", "--socket", str(axis))
    assert run(["track", *words, "--plot", str(page)]) == 1
    stop.join()
    assert stopping[0].wait(20) == 0
    captured = capsys.readouterr()
    told = captured.out.splitlines()
    assert re.match(r"motion broken off: RMS error \S+ mrad, peak error \S+ mrad", told[0]) and len(told) == 3
    why = rf"motion broken off \(the motion ended with the axis in \w+: process {stopping[0].pid} stopped it\): RMS "
    assert re.search(f'id="verdict" class="told">{why}', page.read_text())
    assert re.match(r"peak torque \S+ N\*m; \d+ of \d+ cycles missed", told[1])
    assert captured.err.startswith("servoctl: the motion ended with the axis in ") and captured.err.count("\n") == 1


def test_an_interrupted_motion_is_drawn_with_the_reason(servoctl: Servoctl, axis: Path, tmp_path: Path) -> None:
    servoctl("enable")
    page, words = tmp_path / "motion.html", ("--amplitude", "0.02", "--frequency", "1", "--duration", "30", "--json")
    command = [sys.executable, "-m", "servod.cli", "track", "sine", *words, "--plot", str(page), "--socket", str(axis)]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as track:
        while not servoctl.json("status")["axis"]["motion_running"]:
            time.sleep(0.05)
        time.sleep(1.5)
        track.send_signal(signal.SIGINT)
        assert track.wait(60) == 130
    assert (
        "motion broken off (stopped by Ctrl-C or SIGTERM: the axis is brought to rest and disabled): RMS error"
        in page.read_text()
    )


def test_a_motion_is_drawn_with_its_every_cycle(servoctl: Servoctl, tmp_path: Path) -> None:
    servoctl("enable")
    page, words = tmp_path / "motion.html", ("--amplitude", "0.005", "--frequency", "20", "--duration", "0.5")
    assert servoctl("track", "sine", *words, "--plot", str(page)).endswith(f"\ndrawn: {page}\n")
    text = page.read_text()
    assert "motion done: RMS error" in text and "state feedback" in text
    (row,) = (one for one in servoctl.json("gains", "list")["gains"] if one["active"])
    assert f"{row['name']} version {row['version']}, sha256 {row['sha256']}" in text
    time_s, reference = kept(text)[0]
    assert time_s[-1] > 0.9 and np.median(np.diff(time_s)) == pytest.approx(1e-3, rel=0.05)
    assert np.ptp(reference) == pytest.approx(0.01, rel=2e-2)
    turns = np.flatnonzero(np.diff(np.sign(np.diff(reference))) != 0)
    assert len(turns) >= 19


def test_stop_ends_a_motion_and_switches_off(servoctl: Servoctl) -> None:
    servoctl("enable")
    servoctl("track", "paper", "--duration", "20", "--no-wait")
    assert servoctl.json("status")["axis"]["motion_running"] is True
    assert servoctl("stop") == "stopped\n"
    assert servoctl.state == "DISABLED"


def test_a_motion_from_a_file_is_relative_and_ends_where_the_file_ends(servoctl: Servoctl, tmp_path: Path) -> None:
    file = tmp_path / "motion.csv"
    file.write_text("t_s,reference_rad\n0,0\n0.25,0.01\n0.5,0.02\n")
    servoctl("enable")
    before = servoctl.json("status")["motion"]["reference_rad"]
    servoctl("track", "csv", str(file))
    assert servoctl.json("status")["motion"]["reference_rad"] == pytest.approx(before + 0.02)


def test_a_motion_from_a_spreadsheet_has_a_byte_order_mark(servoctl: Servoctl, tmp_path: Path) -> None:
    file = tmp_path / "motion.csv"
    file.write_text("t_s,reference_rad\n0,0\n0.25,0.01\n", encoding="utf-8-sig")
    servoctl("enable")
    assert servoctl("track", "csv", str(file)).startswith("motion done: ")
    assert servoctl.json("status")["timing"]["period_us"] == 1000


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_whatever_ends_track_stops_the_axis(servoctl: Servoctl, number: signal.Signals) -> None:
    servoctl("enable")
    screen, terminal = pty.openpty()
    words = ["track", "paper", "--duration", "20", "--socket", str(servoctl.socket)]
    track = subprocess.Popen([sys.executable, "-m", "servod.cli", *words], stdout=subprocess.PIPE, stderr=terminal)
    os.close(terminal)
    shown = b""
    with contextlib.suppress(OSError):  # it has ended
        while b"reference +" not in shown:
            shown += os.read(screen, 4096)
    assert b"reference +" in shown, shown.decode()
    assert b" of 20.0 s" in shown
    track.send_signal(number)
    assert track.wait(10) == 130
    os.close(screen)
    assert servoctl.state == "DISABLED"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_whatever_ends_enable_leaves_the_axis_off(tmp_path: Path, number: signal.Signals) -> None:
    """Also SIGKILL, which leaves the command no time to say anything."""
    config = demo_config(tmp_path, tmp_path / "recordings")
    slowly = config.wiring_proof.model_copy(update={"enabled": True, "ramp_s": 10.0, "timeout_s": 40.0})
    config = config.model_copy(update={"wiring_proof": slowly})
    with running_axis(config, plant_file(None), tmp_path), ControlClient(config.control.socket) as watcher:
        LOGS.append(tmp_path / "servod.log")

        def comes_to(wanted: str) -> str:
            """The state that is wanted, or the last one."""
            states = (str(status["axis"]["state"]) for status in itertools.islice(watcher.watch(0.05), 400))
            return next((state for state in states if state in (wanted, "FAULT")), "none of both")

        words = ["enable", "--socket", str(config.control.socket)]
        enable = subprocess.Popen([sys.executable, "-m", "servod.cli", *words], stderr=subprocess.DEVNULL)
        assert comes_to("PROVING") == "PROVING"
        enable.send_signal(number)
        assert enable.wait(10) == (130 if number is signal.SIGINT else -number)
        assert comes_to("DISABLED") == "DISABLED"
        with ControlClient(config.control.socket) as client:
            assert client.call("status")["wiring"]["last"]["finding"] == "INTERRUPTED"


def test_what_is_refused_says_why_with_exit_code_3(servoctl: Servoctl) -> None:
    assert "not enabled" in servoctl("track", "paper", code=3)
    servoctl("enable")
    assert "position_min_rad" in servoctl("track", "step", "--amplitude", "5", code=3)
    assert "limits.following_error_rad" in servoctl("track", "step", "--amplitude", "0.35", code=2)
    assert servoctl.state == "ENABLED"


def test_one_commands_and_others_watch(servoctl: Servoctl) -> None:
    with ControlClient(servoctl.socket) as commander:
        commander.call("enable")
        assert servoctl.json("status")["lease"]["pid"] > 0
        assert "commands the axis" in servoctl("track", "paper", code=3)
        assert servoctl.state == "ENABLED"
        servoctl("stop")  # anyone may stop
        assert servoctl.state == "DISABLED"


def test_gains_load_activate_list_and_roll_back(servoctl: Servoctl) -> None:
    servoctl("enable")
    first = servoctl.json("gains", "load", str(gains_file("pd")), "--activate")
    second = servoctl.json("gains", "load", str(gains_file("local")), "--activate")
    assert servoctl.json("status")["controller"]["law"] == "local"
    rows = servoctl.json("gains", "list")["gains"]
    assert [row["name"] for row in rows if row["active"]] == [second["name"]]
    assert second["name"] in servoctl("gains", "list")
    assert first["name"] in servoctl("gains", "rollback")
    assert servoctl.json("status")["controller"]["law"] == "pd"
    assert first["name"] in servoctl("gains", "activate", first["name"])
    assert "nobody" in servoctl("gains", "activate", "nobody", code=2)


def test_record_and_export(servoctl: Servoctl, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    started = servoctl.json("record", "start", "--name", "trial.mcap")
    servoctl("enable")
    servoctl("track", "step", "--amplitude", "0.01", "--duration", "0.3")
    stopped = servoctl.json("record", "stop")
    assert stopped["path"] == started["path"] and stopped["records"] > 300
    for suffix in (".csv", ".parquet"):
        out = tmp_path / f"trial{suffix}"
        assert run(["record", "export", started["path"], "--out", str(out), "--json"]) == 0
        assert json.loads(capsys.readouterr().out)["rows"] == stopped["records"]
    header, *rows = (tmp_path / "trial.csv").read_text().splitlines()
    assert {"t_s", "position_rad", "reference_rad", "torque_nm"} <= set(header.split(","))
    assert len(rows) == stopped["records"]


def test_what_is_not_recorded_cannot_be_stopped(servoctl: Servoctl) -> None:
    assert "not recording" in servoctl("record", "stop", code=1)


def test_a_recording_goes_nowhere_else(servoctl: Servoctl) -> None:
    assert "recordings" in servoctl("record", "start", "--name", "/tmp/elsewhere.mcap", code=2)


def test_scan_lists_both_nodes(servoctl: Servoctl) -> None:
    nodes = servoctl.json("scan")["nodes"]
    assert [node["node_id"] for node in nodes] == [1, 2]
    text = servoctl("scan")
    assert "CiA 402" in text and "CiA 406" in text


def test_scan_asks_the_bus_itself_where_no_daemon_is(
    axis: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["scan", "--interface", "virtual", "--json", "--channel"]
    assert run([*words, str(axis.parent / "bus")]) == 3
    assert "another servod" in capsys.readouterr().err
    bus, log = tmp_path / "bus", tmp_path / "virtual-axis.log"
    with child("servod.drivers.virtual.main", ["--socket", str(bus), "--plant", str(plant_file(None))], log) as alone:
        wait_until(bus.exists, alone, log, 20.0)
        assert run([*words, str(bus)]) == 0
    nodes = json.loads(capsys.readouterr().out)["nodes"]
    assert [node["node_id"] for node in nodes][:2] == [1, 2]


def test_preset_leaves_an_axis_alone_that_a_daemon_runs(axis: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["preset", str(axis.parent / "axis.yaml"), "--position-rad", "0"]) == 3
    assert "another servod" in capsys.readouterr().err


def test_faults_are_told_by_the_daemon(servoctl: Servoctl) -> None:
    document = servoctl.json("faults", "--last", "1000")
    latched = [fault["code"] for fault in servoctl.json("status")["faults"]]  # on a busy machine: lateness
    assert (document["source"], document["now"], document["not_read"]) == ("daemon", latched, [])
    assert Path(document["folder"]).name == "recordings"
    assert "REC" not in servoctl("faults")


def test_status_is_one_screen(servoctl: Servoctl) -> None:
    text = servoctl("status")
    assert "demo is DISABLED" in text and "deadline to torque" in text
    assert len(text.splitlines()) <= 30


def test_a_daemon_that_is_not_there_is_unreachable(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for verb in (["status"], ["enable"], ["stop"], ["gains", "list"], ["record", "stop"], ["scan"]):
        assert run([*verb, "--socket", str(tmp_path / "none.sock")]) == 3
        captured = capsys.readouterr()
        assert (captured.out, len(captured.err.splitlines())) == ("", 1)
        assert "none.sock" in captured.err
