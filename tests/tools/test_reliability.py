"""The manual's table of reliability says what the documents say, also what is bad."""

from __future__ import annotations

import pytest
import reliability

_TIMES = {"count": 2, "median_ms": 3, "largest_ms": 148.6, "bins_ms": {"3": 1, "148": 1}}
_SOAK = {
    **{"mode": "stepped", "cycles": 3_600_010, "rows": 3_600_000, "missed": 3, "syncs": 3_599_990, "syncs_taken": 6},
    **{"axis_hours": 1.0, "wall_s": 360.0, "faults_injected": 1200, "faults_found": 1199, "restarts": 7},
    "faults": {"encoder cut off": {"torque_gone": _TIMES, "injected": 3, "found": 2, "recovered": 3}},
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
    assert out.startswith("7 rows lost; 4 apart from SYNC on the bus; 2 of 3 faults that stop the axis in")
    assert out.endswith("torque gone after 149 ms at the latest; memory of soak flat (-20 to 34 kB/h)")
    assert command == "`servoctl qualify soak`"


_NONE = {"count": 0, "median_ms": 0, "largest_ms": 0.0, "bins_ms": {}}
_STOPS = {"injected": 40, "found": 39, "recovered": 40, "torque_gone": _TIMES}
_RIDDEN = {"injected": 30, "recovered": 30, "torque_gone": _NONE}


@pytest.mark.parametrize(
    ("stops", "rides", "told"),
    [
        (
            {"due": 40, "ridden": 0, "spoilt": 0},
            {"due": 0, "found": 0, "ridden": 28, "spoilt": 2},
            [
                "28 of 30 others seen on the bus and ridden through",
                "2 of them seen on the bus and the wiring tested again",
            ],
        ),
        ({}, {"found": 30}, ["enabled after 30 of 30 others"]),
    ],
)
def test_what_was_ridden_through_is_told_apart_from_what_the_log_says(
    stops: dict[str, int], rides: dict[str, int], told: list[str]
) -> None:
    """Documents of before there was a trace count all of them as found."""
    soak = {**_SOAK, "faults": {"safe torque off": {**_STOPS, **stops}, "frames destroyed": {**_RIDDEN, **rides}}}
    ((_, _, out, _),) = reliability.rows([soak], None, None)
    assert out.split("; ")[2 : 3 + len(told)] == ["39 of 40 faults that stop the axis in the log", *told]


def test_the_campaign_and_fuzzing_are_told_with_what_failed() -> None:
    campaign, feedback, fuzzing = reliability.rows([], _FAULTS, _FUZZ)
    assert campaign[1:3] == ["48 of 50 scenarios", "47 passed; 2 cycle records lost"]
    (stepped, *_) = reliability.rows([], {**_FAULTS, "recorded": 0}, None)
    assert (stepped[2], stepped[3]) == ("47 passed", "`servoctl qualify faults --stepped`")
    (recorded, *_) = reliability.rows([], {**_FAULTS, "recorded": 9}, None)
    assert recorded[2:] == ["47 passed; 2 cycle records lost in 9 with a recorder", "`servoctl qualify faults`"]
    assert feedback[2] == "the drive had left the command after 21 ms at the latest"
    assert fuzzing[1:3] == ["1,000 inputs to 1 ways in, 1.00 h", "1 crashes"]


_FAILURES = """| Part | Failure | ms | Behind the row |
| cable | the drive | 19 | 31 | `servoctl qualify faults --only 'cut_off/amplifier'` |
| Bus | cut | 127 / 149 | `cut_off/amplifier` |
| Joint | overload | rides | `overload_clips` |
| Kernel | gone | the same | `vcan_interface_gone`, by `scripts/guest` |
"""


def test_failure_modes_have_the_times_of_the_campaign() -> None:
    cut = {"name": "cut_off/amplifier", "axis": "FAULT", "left_ms": 20.4, "gone_ms": 43.3}
    clips = {"name": "overload_clips", "axis": "ENABLED", "left_ms": None, "gone_ms": None}
    faults = {"scenarios": [cut, clips]}
    assert reliability.with_times(_FAILURES, faults) == _FAILURES.replace("127 / 149", "20 / 43").replace(
        "19 | 31", "20 | 43"
    )
    faults["scenarios"][0] = {**cut, "gone_ms": 20.1}
    assert "| cut | 20 |" in reliability.with_times(_FAILURES, faults)
    clips["axis"] = "FAULT"
    with pytest.raises(ValueError, match="overload_clips: FAULT, in the table rides"):
        reliability.with_times(_FAILURES, faults)
