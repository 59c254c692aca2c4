"""The shipped gain sets are what their script makes; a changed demo joint or constant shows here."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path


def test_the_script_would_write_what_ships() -> None:
    root = Path(__file__).resolve().parents[3]
    command = [sys.executable, "scripts/make_gain_sets.py", "--check"]
    result = subprocess.run(command, cwd=root, capture_output=True, text=True, timeout=60)
    assert (result.returncode, result.stdout, result.stderr) == (0, "", "")
