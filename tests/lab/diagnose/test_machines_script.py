"""What the table of real machines calls unseen is unseen."""

from __future__ import annotations

import runpy
from pathlib import Path

SCRIPT = Path(__file__).resolve().parents[3] / "scripts" / "real_machines.py"


def test_a_row_says_when_the_fit_has_seen_its_recording() -> None:
    machines = {machine.example: machine for machine in runpy.run_path(str(SCRIPT))["MACHINES"]}
    for machine in machines.values():
        assert not set(machine.seen) & set(machine.unseen)
        for name, what in machine.judged().items():
            assert what.endswith("(the fit has seen it)") is (name in machine.seen)
    assert len(machines["odrive"].judged()) == 2  # all runs without compensation but the one that was diagnosed
