"""The demo as its user sees it: the JSON document, the report, and nothing left running however it ends."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml

from servod.cli.app import run
from servod.cli.demo import print_document
from servod.common.errors import ServodError
from servod.common.faults import FAULTS, FaultCode
from servod.common.shipped import shipped
from servod.qualify.demo.entries import entries
from servod.qualify.demo.wall_clock import why
from tests.starved import LOGS

#: Both lines of the paper's story: feedback alone sticks, a friction model removes most of the error.
STUCK_MRAD, COMPENSATED_MRAD = 10.0, 2.0


def check(document: dict, out: Path) -> None:
    """The documented keys, errors in the right order, and a report."""
    scores = document["controllers"]
    assert list(scores) == ["pd", "pd_dob", "pd_lugre", "local"]
    for score in scores.values():
        assert set(score) == {"rms_error_mrad", "max_error_mrad"}
        assert 0.0 < score["rms_error_mrad"] <= score["max_error_mrad"]
    rms = {name: score["rms_error_mrad"] for name, score in scores.items()}
    assert rms["pd"] > STUCK_MRAD
    missed = document["missed"] > 0  # each may cost any of them a millirad or two
    assert max(rms["pd_dob"], rms["pd_lugre"], rms["local"]) < (STUCK_MRAD if missed else COMPENSATED_MRAD)
    assert missed or rms["local"] == min(rms.values())
    assert document["wall_s"] > 0.0
    assert (out / "report.html").stat().st_size > 300_000


def test_the_fast_demo_prints_one_document(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["demo", "--fast", "--seconds", "3", "--json", "--out", str(tmp_path)]) == 0
    captured = capsys.readouterr()
    document = json.loads(captured.out)
    check(document, tmp_path)
    assert captured.err == ""
    assert list(document["others"]) == ["demo_local_plain", "table1_kz_kv_kx", "table1_kx_kv_kz", "local_certified"]
    assert document["others"]["local_certified"]["rms_error_mrad"] < document["controllers"]["local"]["rms_error_mrad"]
    assert list(document["certified"]) == ["local_certified"]
    assert document["certified"]["local_certified"]["plants"] >= 1000
    assert document["missed"] == 0
    assert document["cycles"] == pytest.approx(4 * 3000, abs=8)


def test_further_gain_sets_run_beside_the_four(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plain = str(shipped("gains/demo_local_plain.yaml"))
    assert run(["demo", "--fast", "--seconds", "3", "--out", str(tmp_path), "--gains", plain, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    check(document, tmp_path)
    assert list(document["others"]) == ["demo_local_plain", "local_certified"]
    assert document["others"]["demo_local_plain"]["rms_error_mrad"] < COMPENSATED_MRAD


@pytest.mark.parametrize("mode", [[], ["--fast"]], ids=["wall", "fast"])
@pytest.mark.parametrize("folder", ["/proc/nowhere", "{file}/demo"], ids=["not made", "a file"])
def test_a_folder_that_cannot_be_is_refused_before_anything_runs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, mode: list[str], folder: str
) -> None:
    (tmp_path / "file").touch()
    out = folder.format(file=tmp_path / "file")

    def ran(*_: object) -> None:
        pytest.fail("the demo ran")

    monkeypatch.setattr("servod.cli.demo._run", ran)
    assert run(["demo", *mode, "--out", out]) == 2
    captured = capsys.readouterr()
    (line,) = captured.err.splitlines()
    assert captured.out == "" and f"--out {out}" in line


def test_the_table_names_options_and_refused_rights(capsys: pytest.CaptureFixture[str]) -> None:
    rows, score = entries(), {"rms_error_mrad": 1.0, "max_error_mrad": 2.0}
    document = {"controllers": {row.name: score for row in rows}, "cycles": 1, "missed": 0, "wall_s": 1.0}
    print_document(rows, document | {"realtime_refused": ["sched_fifo (not permitted)"], "report": "report.html"})
    said = capsys.readouterr().out
    assert "observer 50 rad/s" in said and "sched_fifo (not permitted)" in " ".join(said.split())


def test_the_plant_can_be_another_joint(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plant = tmp_path / "smooth.yaml"
    plant.write_text("inertia: 0.001\nfriction: {kind: coulomb_viscous, viscous: 0.056, coulomb: 0.001}\n")
    assert run(["demo", "--fast", "--seconds", "3", "--json", "--out", str(tmp_path), "--plant", str(plant)]) == 0
    document = json.loads(capsys.readouterr().out)
    scores = document["controllers"]
    assert "others" not in document and document["certified"] == {}
    assert scores["pd"]["rms_error_mrad"] < STUCK_MRAD


@pytest.mark.parametrize(
    ("plant", "code"),
    [
        ("{friction: {kind: coulomb_viscous, viscous: 0.056, coulomb: 0.2}, torque_offset: 0.4}", "SPEED_LIMIT"),
        ("{inertia: 1.0e-5, friction: {kind: coulomb_viscous, viscous: 0.0, coulomb: 0.0}}", "WIRING_NOT_PROVEN"),
    ],
)
def test_a_fault_in_virtual_time_is_named_with_its_remedy(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], plant: str, code: str
) -> None:
    (tmp_path / "wild.yaml").write_text(yaml.safe_dump({"inertia": 0.001} | yaml.safe_load(plant)))
    words = ["demo", "--fast", "--seconds", "2", "--json", "--out", str(tmp_path)]
    assert run([*words, "--plant", str(tmp_path / "wild.yaml")]) == 1
    said = capsys.readouterr().err
    fault = FAULTS[FaultCode[code]]
    assert "not enabled" in said and f"{code}: {fault.cause} {fault.remedy}" in said


@pytest.mark.parametrize(
    ("fault", "starved"),
    [
        (FaultCode.SUPERVISOR_LOST, True),
        (FaultCode.DEADLINE_BUDGET, True),
        (FaultCode.FEEDBACK_STALE, True),
        (FaultCode.SPEED_LIMIT, False),
    ],
)
def test_faults_of_lateness_name_the_busy_machine(fault: FaultCode, starved: bool) -> None:
    row = FAULTS[fault]
    rows = [{"code": fault.name, "cause": row.cause, "remedy": row.remedy}]
    said = why(rows, 0.001)
    assert said.startswith(f"{fault.name}: {row.cause} {row.remedy}")
    assert ("wants the machine for itself" in said) == starved
    assert "(12% of the cycles were missed): the demo on the wall clock wants the machine for itself" in why(rows, 0.12)


def start(tmp_path: Path, *arguments: str) -> subprocess.Popen[str]:
    """The demo on the wall clock, with its temporary files under `tmp_path`."""
    command = [sys.executable, "-m", "servod.cli", "demo", "--out", str(tmp_path / "out"), *arguments]
    environment = os.environ | {"TMPDIR": str(tmp_path)}
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def started_by(tmp_path: Path) -> list[str]:
    """Command lines of all processes that name a file under `tmp_path`, the demo itself not counted."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            command = (process / "cmdline").read_bytes().replace(b"\0", b" ").decode()
        except OSError:
            continue
        if f"{tmp_path}/servod-demo-" in command:
            found.append(command)
    return found


def keep_log(tmp_path: Path) -> None:
    """The daemon's log, which goes with the demo's folder: it says whether the drive's fault was want of heartbeats."""
    kept = tmp_path / "servod.log"
    for log in tmp_path.glob("servod-demo-*/servod.log"):
        with contextlib.suppress(FileExistsError, FileNotFoundError):  # there already; gone with its demo
            kept.hardlink_to(log)
            LOGS.append(kept)


def wait_until_it_moves(demo: subprocess.Popen[str], tmp_path: Path) -> None:
    deadline = time.monotonic() + 90.0
    while not list(tmp_path.glob("out/recordings/pd.mcap")):
        keep_log(tmp_path)
        if demo.poll() is not None:
            raise ServodError(f"the demo ended with {demo.returncode} before it moved: {demo.communicate()}")
        if time.monotonic() > deadline:
            raise TimeoutError(f"no motion after 90 s; {started_by(tmp_path)}")
        time.sleep(0.1)


@pytest.mark.serial
def test_the_demo_on_the_wall_clock(tmp_path: Path) -> None:
    demo = start(tmp_path, "--seconds", "2.5", "--json")
    wait_until_it_moves(demo, tmp_path)
    out, err = demo.communicate(timeout=60)
    if demo.returncode:
        raise ServodError(f"the demo ended with {demo.returncode}: {err}")
    assert err == ""
    check(json.loads(out), tmp_path / "out")
    assert sorted(f.stem for f in (tmp_path / "out/recordings").glob("*.mcap")) == [
        *("local", "local_certified", "pd", "pd_dob", "pd_lugre")
    ]
    assert started_by(tmp_path) == []


@pytest.mark.serial
@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 130), (signal.SIGHUP, 130), (signal.SIGKILL, -9)]
)
def test_nothing_is_left_running(tmp_path: Path, number: signal.Signals, code: int) -> None:
    demo = start(tmp_path)
    wait_until_it_moves(demo, tmp_path)
    assert len(started_by(tmp_path)) >= 2
    demo.send_signal(number)
    _, err = demo.communicate(timeout=30)
    assert demo.returncode == code
    assert "Traceback" not in err
    deadline = time.monotonic() + 10.0
    while started_by(tmp_path):
        assert time.monotonic() < deadline, started_by(tmp_path)
        time.sleep(0.1)
