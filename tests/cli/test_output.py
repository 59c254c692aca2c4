"""Where standard output goes is no reason for a traceback."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest


def servoctl(*words: str, **options: Any) -> subprocess.CompletedProcess[bytes]:
    command = [sys.executable, "-m", "servod.cli", *words]
    return subprocess.run(command, stderr=subprocess.PIPE, timeout=60, check=False, **options)


@pytest.mark.parametrize("words", [("faults", "--codes"), ("faults", "--codes", "--json"), ("--help",)])
def test_a_full_disk_is_one_line(words: tuple[str, ...]) -> None:
    with Path("/dev/full").open("wb") as full:
        done = servoctl(*words, stdout=full)
    assert (done.returncode, done.stderr) == (1, b"servoctl: standard output: No space left on device\n")


@pytest.mark.parametrize("words", [("faults", "--codes"), ("faults", "--codes", "--json")])
def test_a_reader_that_has_gone_is_silence(words: tuple[str, ...]) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    done = servoctl(*words, stdout=writer)
    os.close(writer)
    assert (done.returncode, done.stderr) == (1, b"")


@pytest.mark.parametrize(("closed", "code"), [(">&-", 1), ("2>&-", 0)])
def test_a_closed_stream_is_no_traceback(closed: str, code: int) -> None:
    command = ["sh", "-c", f'exec "$0" -m servod.cli faults --codes {closed}', sys.executable]
    done = subprocess.run(command, capture_output=True, timeout=60, check=False)
    told = b"servoctl: standard output: Bad file descriptor\n" if code else b""
    assert (done.returncode, done.stderr) == (code, told)
    assert (b"TORQUE_CLIPPED" in done.stdout) == (code == 0)


def test_a_bill_of_materials_for_a_full_disk_is_one_line() -> None:
    script = Path(__file__).parents[2] / "scripts/sbom.py"
    with Path("/dev/full").open("wb") as full:
        done = subprocess.run([sys.executable, script], stdout=full, stderr=subprocess.PIPE, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (1, b"sbom: standard output: No space left on device\n")


def test_a_terminal_without_the_characters_gets_the_rest() -> None:
    plain = {"PATH": os.environ["PATH"], "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONIOENCODING": "ascii"}
    done = servoctl("faults", "--codes", stdout=subprocess.PIPE, env=plain)
    assert (done.returncode, done.stderr) == (0, b"")
    assert b"TORQUE_CLIPPED" in done.stdout
