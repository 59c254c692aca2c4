"""The README's table of reliability says what the documents say, also what is bad."""

from __future__ import annotations

import reliability

_TIMES = {"count": 2, "median_ms": 3, "largest_ms": 148.6, "bins_ms": {"3": 1, "148": 1}}
_SOAK = {
    **{"mode": "stepped", "cycles": 3_600_010, "rows": 3_600_000, "missed": 3, "syncs": 3_599_990, "syncs_taken": 6},
    **{"axis_hours": 1.0, "wall_s": 360.0, "faults_injected": 1200, "faults_found": 1199, "restarts": 7},
    "faults": {"encoder cut off": {"torque_gone": _TIMES}},
    "wrong": {"lost row": 7, "unexplained state": 1},
    "memory": [{"process": "soak", "growth": "flat", "interval_kb_per_h": [-20.4, 33.6]}],
}
_WORST = {"feedback": {"scenarios": 2, "left_ms": 21.4, "gone_ms": None}, "master": {"scenarios": 0}}
_FAULTS = {"planned": 50, "run": 48, "passed": 47, "lost_records": 2, "worst": _WORST}
_FUZZ = [
    {"target": "yaml", "way": "bytes", "inputs": 900, "seconds": 1800.0, "crashes": []},
    {"target": "yaml", "way": "shaped", "inputs": 100, "seconds": 1800.0, "crashes": [{"key": "KeyError"}] * 2},
]


def test_a_soak_is_told_with_what_was_lost() -> None:
    ((_, much, out, command),) = reliability.rows([_SOAK], None, None)
    assert much == "3,600,010 cycles (1.0 h of axis time in 0.10 h), 1,200 faults of 1 kinds, 7 restarts"
    assert out.startswith("7 rows lost; 4 apart from SYNC on the bus; 1,199 faults in the log; 8 unexplained")
    assert out.endswith("torque gone after 149 ms at the latest; memory of soak flat (-20 to 34 kB/h)")
    assert command == "`servoctl soak`"


def test_the_campaign_and_fuzzing_are_told_with_what_failed() -> None:
    campaign, feedback, fuzzing = reliability.rows([], _FAULTS, _FUZZ)
    assert campaign[1:3] == ["48 of 50 scenarios", "47 passed; 2 cycle records lost"]
    assert feedback[2] == "the drive had left the command after 21 ms at the latest"
    assert fuzzing[1:3] == ["1,000 inputs to 1 ways in, 1.00 h", "1 crashes"]
