"""What works on files alone works on Windows and macOS; what needs a daemon says in one line that it needs Linux."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest
import yaml

from servod.cli.app import run
from servod.formats.gains.gain_set import parse_gains
from tests.formats.gains import good
from tests.fuzz.recordings import recorded

ROOT = Path(__file__).parents[2]
ELSEWHERE = Path(__file__).parent / "elsewhere"
PLATFORMS = ("win32", "darwin")
DRY = {"kind": "coulomb_viscous", "coulomb": 0.045, "viscous": 0.02}


class Done(NamedTuple):
    """What came of a command line: exit code, what it said, and the files that it wrote, by name."""

    code: int
    out: str
    err: str
    written: dict[str, bytes]


def python(folder: Path, platform: str, *words: str, told: str = "") -> subprocess.CompletedProcess[str]:
    path = os.pathsep.join([str(ELSEWHERE), str(ROOT)])
    environment = {**os.environ, "PYTHONPATH": path, "SERVOD_ELSEWHERE": platform}
    environment.pop("SERVOD_SOCKET", None)
    return subprocess.run(
        [sys.executable, *words], cwd=folder, env=environment, input=told, capture_output=True, text=True,
        timeout=110, check=False,
    )  # fmt: skip


def servoctl(folder: Path, platform: str, *words: str) -> subprocess.CompletedProcess[str]:
    return python(folder, platform, "-m", "servod.cli", *words)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model, a gain set, a recording of servod's, and a run of an axis with more inertia than the model says."""
    folder = tmp_path_factory.mktemp("files")
    model = {"inertia": 0.001, "delay_s": 0.0, "friction": DRY}
    (folder / "model.yaml").write_text(yaml.safe_dump(model))
    (folder / "gains.yaml").write_text(good.PD)
    (folder / "certified.yaml").write_text(good.certified(parse_gains(good.PD, "good")).to_yaml())
    recorded(folder / "run.mcap")
    _run(folder / "one.csv")
    return folder


def _run(path: Path) -> None:
    """An axis of 1.5 times the inertia and dry friction under a torque of two tones."""
    parts, period = 10, 0.004
    x = v = 0.0
    rows = ["t_s,torque_nm,position_rad"]
    for k in range(600):
        t = k * period
        torque = 0.09 * math.sin(4.4 * t) + 0.05 * math.sin(13.6 * t)
        rows.append(f"{t:.3f},{torque:.6f},{x:.9f}")
        for _ in range(parts):
            v += period / parts * (torque - 0.045 * math.tanh(1e3 * v) - 0.02 * v) / 0.0015
            x += period / parts * v
    path.write_text("\n".join(rows) + "\n")


ON_FILES = {
    "help": ["--help"],
    "version": ["--version"],
    "explain": ["explain", "stribeck", "--json"],
    "replay": ["replay", "--model", "model.yaml", "one.csv", "--horizon", "0.25", "--json"],
    "gains show": ["gains", "show", "gains.yaml", "--json"],
    "config check": ["config", "check", "gains.yaml", "model.yaml", "--json"],
    "fault codes": ["faults", "--codes", "--json"],
    "plot": ["plot", "run.mcap", "--out", "OUT/run.png"],
    "export": ["record", "export", "run.mcap", "--out", "OUT/run.csv"],
}


#: What acts on a machine.
ON_LINUX = (
    *(["status"], ["enable"], ["stop", "--socket", "axis.sock"], ["track", "paper"], ["gains", "list"]),
    *(["record", "start"], ["scan"], ["scan", "--channel", "can0"], ["preset", "axis.yaml", "--position-rad", "0"]),
    *(["bench", "--quick"], ["demo", "--out", "demo"], ["deploy", "certified.yaml"]),
)


@pytest.fixture(scope="module")
def done(files: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Done]]:
    """What came of every command line, by place and its words; here nothing is asked of a machine."""
    return {where: _all_done(files, where, tmp_path_factory.mktemp(f"on_{where}")) for where in ("", *PLATFORMS)}


def _all_done(files: Path, where: str, folder: Path) -> dict[str, Done]:
    asked = [*ON_FILES.values(), *(ON_LINUX if where else ())]
    outs = [folder / str(number) for number in range(len(asked))]
    for out in outs:
        out.mkdir()
    lines = [[word.replace("OUT", str(out)) for word in words] for words, out in zip(asked, outs, strict=True)]
    ran = python(files, where, str(ELSEWHERE / "commands.py"), told=json.dumps(lines))
    assert ran.returncode == 0, ran.stderr
    found = {}
    for words, out, (code, said, complained) in zip(asked, outs, json.loads(ran.stdout), strict=True):
        written = {path.name: path.read_bytes() for path in out.iterdir()}
        found[" ".join(words)] = Done(code, said.replace(str(out), "OUT"), complained, written)
    return found


@pytest.mark.parametrize("words", ON_FILES.values(), ids=list(ON_FILES))
def test_the_same_comes_out(words: list[str], done: dict[str, dict[str, Done]]) -> None:
    here, *elsewhere = (done[where][" ".join(words)] for where in ("", *PLATFORMS))
    assert here.code == 0, here.err
    assert here.out or here.written
    assert elsewhere == [here] * len(PLATFORMS)


@pytest.mark.parametrize("platform", PLATFORMS)
def test_the_program_itself_starts_and_refuses_in_one_line(platform: str, files: Path) -> None:
    begun = servoctl(files, platform, "--version")
    assert (begun.returncode, begun.stderr) == (0, "") and begun.stdout.startswith("servoctl ")
    refused = servoctl(files, platform, "status")
    assert (refused.returncode, refused.stdout) == (3, "") and "needs Linux" in refused.stderr


@pytest.mark.parametrize("platform", ["win32"])  # which lacks what macOS lacks, and more
def test_a_diagnosis_comes_out_the_same(
    platform: str, files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    here, there = tmp_path / "here", tmp_path / platform
    words = ["diagnose", "--model", "model.yaml", "one.csv", "--out"]
    done = servoctl(files, platform, *words, str(there))
    assert done.returncode == 0, done.stderr
    monkeypatch.chdir(files)
    assert run([*words, str(here)]) == 0
    said = capsys.readouterr().out
    assert "inertia" in said
    assert done.stdout.replace(str(there), "OUT") == said.replace(str(here), "OUT")
    assert (there / "model.yaml").read_text() == (here / "model.yaml").read_text()


@pytest.mark.parametrize("platform", ["win32"])
def test_a_set_is_designed_and_verified(platform: str, files: Path, tmp_path: Path) -> None:
    """A look with a few plants: worker processes start there, too. It cannot certify (exit code 1)."""
    model = {"inertia": 0.001, "delay_s": 0.001}
    lugre = {"kind": "lugre", "sigma0": 950.0, "sigma1": 1.0, "viscous": 0.056, "coulomb": 0.045, "static": 0.07}
    (tmp_path / "model.yaml").write_text(yaml.safe_dump(model | {"friction": lugre | {"stribeck_velocity": 0.1}}))
    done = servoctl(tmp_path, platform, "synthesize", "--model", "model.yaml", "--out", "gains.yaml", "--json")
    assert (done.returncode, done.stderr) == (0, "")
    assert b"\r" not in (tmp_path / "gains.yaml").read_bytes()
    done = servoctl(tmp_path, platform, "verify", "gains.yaml", "--plants", "10", "--json")
    assert done.returncode == 1 and "Traceback" not in done.stderr, done.stderr


@pytest.mark.parametrize("platform", PLATFORMS)
@pytest.mark.parametrize("words", ON_LINUX, ids=" ".join)
def test_what_needs_a_daemon_says_that_it_needs_linux(
    words: list[str], platform: str, done: dict[str, dict[str, Done]]
) -> None:
    found = done[platform][" ".join(words)]
    (line,) = found.err.splitlines()
    assert (found.code, found.out, found.written) == (3, "", {})
    assert "needs Linux" in line and {"win32": "Windows", "darwin": "macOS"}[platform] in line


@pytest.mark.parametrize("platform", PLATFORMS)
def test_a_folder_is_given_to_one_command_at_a_time(platform: str, tmp_path: Path) -> None:
    code = (
        "from pathlib import Path\n"
        "__name__ = 'servod.here'\n"
        "from servod.cli import common\n"
        f"out = Path({str(tmp_path / 'out')!r})\n"
        "common.need_folder('--out', out, alone=True)\n"
        "try:\n    common.need_folder('--out', out, alone=True)\n"
        "except common.Unreachable as error:\n    print(error)\n"
        "common.drop_empty_folders()\n"
        "print(out.exists())\n"
    )
    done = python(tmp_path, platform, "-c", code)
    assert done.returncode == 0, done.stderr
    told, left = done.stdout.splitlines()
    assert "another command is at work there" in told and left == "False"
