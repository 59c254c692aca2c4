"""One screen shows state, goal, reasons, faults, values, timing and refused real-time grants."""

from __future__ import annotations

import io
from collections.abc import Iterator
from typing import Any

import pytest
from rich.console import Console

from servod.cli.status import WatchView, follow, screen
from servod.common.faults import FAULTS, FaultCode

FAULT = FAULTS[FaultCode.FOLLOWING_ERROR]
FRESH = {"age_s": 0.002, "stale": False}
STALE = {"age_s": 3.21, "stale": True}
NEVER = {"age_s": None, "stale": True}
GREY = "\x1b[2m"


STOPS = {"time_s": 0.058, "speed_rad_s": 3.6, "travel_rad": 0.14, "coasts_rad": None, "narrowed": ["speed [limits]"]}


def document() -> dict[str, Any]:
    """A status document of an axis that did not get where it should."""
    lag = {"p50_us": 20.0, "p99_us": 60.0, "max_us": 900.0}
    return {
        "name": "joint[3]",
        "axis": {
            "state": "FAULT",
            "goal": "OFF",
            "goal_reached": False,
            "reasons": ["the drive is not ready"],
            "motion_running": False,
        },
        "drive": {"state": "SWITCH_ON_DISABLED", "status_word": "0x0240", "error_code": "0x0000", "mode": 10} | FRESH,
        "brake": {"by": "output", "state": "opening"},
        "inputs": [{"name": "estop", "active": True}, {"name": "sto", "active": False}],
        "motion": {
            "position_rad": 0.25,
            "reference_rad": 0.2,
            "following_error_rad": -0.05,
            "velocity_rad_s": None,
            "torque_nm": 0.0123,
            "torque_friction_nm": 0.0,
        }
        | FRESH,
        "loop": {"pid": 17} | FRESH,
        "stopping": STOPS,
        "guards": {
            "unguarded": True,
            "proof": {"asked_for": True, "holds": False, "time": None, "text": "the guards were never tested"},
        },
        "promise": {"judged": True, "note": "", "motion_s": 5.0, "joint": [], "errors": []},
        "wiring": {"tests": 1, "last": {"passed": False, "text": "wiring test failed (TORQUE_POLARITY): turn it"}},
        "faults": [
            {
                "code": FAULT.code.name,
                "present": False,
                "reaction": FAULT.reaction.name,
                "cause": FAULT.cause,
                "remedy": FAULT.remedy,
            }
        ],
        "controller": {"serial": 1, "name": "trial", "law": "pd", "note": ""},
        "timing": {"window_s": 10.0, "cycle": 12345, "missed": 3, "lag": lag, "tick": lag, "torque": lag},
        "bus": {
            "interface": "socketcan",
            "channel": "can0",
            "load": 0.39,
            "max_load": 0.7,
            "queue_full": 0,
            "error_frames": 2,
        },
        "nodes": [{"node_id": 1, "role": "amplifier", "driver": "cia402", "state": "OPERATIONAL"} | FRESH],
        "grants": [
            {"name": "memory_lock", "granted": True, "reason": ""},
            {"name": "sched_fifo", "granted": False, "reason": "priority 80: Operation not permitted"},
        ],
        "recorder": {"recording": False, "path": "", "records": 0, "failure": "", "removed": 0},
    }


def shown(view: Any, styles: bool = False) -> str:
    console = Console(width=140, record=True, force_terminal=styles, file=io.StringIO())
    console.print(screen(view) if isinstance(view, dict) else view)
    return console.export_text(styles=styles)


@pytest.mark.parametrize(
    "text",
    [
        "joint[3] is FAULT, goal OFF not reached: the drive is not ready",
        "status word 0x0240",
        "was FOLLOWING_ERROR (RAMP_DOWN)",
        "+0.2500 rad",
        "-50.0000 mrad",
        "not finite",
        "trial (pd)",
        "39% of 70% allowed",
        "OPERATIONAL, heard 0.002 s ago",
        "cycle 12345, 3 missed",
        "not granted sched_fifo: priority 80: Operation not permitted",
    ],
)
def test_the_screen_shows(text: str) -> None:
    assert text in shown(document())


def test_the_stop_that_is_stated_and_what_was_narrowed_are_shown() -> None:
    text = shown(document())
    assert "stops within 58 ms, 3.6 rad/s and 0.14 rad after a loss of the master; without the drive it does" in text
    assert "narrowed speed [limits]" in text
    assert "stopping not computed" in shown({**document(), "stopping": None})


def test_what_is_not_as_certified_is_shown() -> None:
    row = {"name": "inertia", "share": 2.0, "standard_error": 0.02, "certified": [0.95, 1.05]}
    error = {"kind": "slow", "rms_rad": 5e-5, "promised_rad": 1e-5}
    promise = {
        "judged": True,
        "note": "",
        "motion_s": 9.0,
        "joint": [row | {"told": True}],
        "errors": [error | {"told": True}],
    }
    text = shown({**document(), "promise": promise})
    assert "not as certified inertia 2.00 times the model's, certified from 0.95 to 1.05; RMS error 0.05 mrad" in text
    promise |= {"joint": [row | {"told": False}], "errors": [error | {"told": False}]}
    assert "not as certified" not in shown({**document(), "promise": promise})


def test_it_is_one_screen() -> None:
    assert len(shown(document()).splitlines()) <= 24


def test_granted_requests_are_not_shown() -> None:
    assert "memory_lock" not in shown(document())


def test_what_is_fresh_is_not_called_stale() -> None:
    assert "stale" not in shown(document())
    assert GREY not in shown(document(), styles=True)


@pytest.mark.parametrize(
    ("part", "age", "lines"),
    [
        ("motion", STALE, ["+0.2500 rad, stale 3.2 s", "+0.2000 rad, stale 3.2 s", "-50.0000 mrad, stale 3.2 s"]),
        ("motion", NEVER, ["+0.2500 rad, never heard"]),
        ("drive", STALE, ["SWITCH_ON_DISABLED (status word 0x0240, error 0x0000, mode 10), stale 3.2 s"]),
        ("loop", STALE, ["the drive is not ready, stale 3.2 s", "+0.0123 N·m, stale 3.2 s", "3 missed; last 10 s"]),
    ],
)
def test_what_is_stale_is_grey_and_says_its_age(part: str, age: dict[str, Any], lines: list[str]) -> None:
    status = document()
    status[part] |= age
    assert [line for line in lines if line not in shown(status)] == []
    assert GREY in shown(status, styles=True)


def test_a_node_that_is_silent_is_grey_and_says_since_when() -> None:
    status = document()
    status["nodes"][0] |= {"state": "silent (was OPERATIONAL)"} | STALE
    assert "silent (was OPERATIONAL), stale 3.2 s" in shown(status)


def test_a_set_that_is_not_the_one_active_last_says_why() -> None:
    status = document()
    status["controller"]["note"] = "active.json is damaged, its copy was taken"
    assert "gain set active.json is damaged, its copy was taken" in shown(status)


def test_into_a_pipe_each_status_goes_out_as_it_comes(capsys: pytest.CaptureFixture[str]) -> None:
    said = []

    def coming() -> Iterator[dict[str, Any]]:
        for _ in range(2):
            yield document()
            said.append(capsys.readouterr().out)

    follow(coming())
    assert ["+0.2500 rad" in text for text in said] == [True, True]


def test_a_watched_status_grows_old_while_the_daemon_is_silent() -> None:
    now_s = 100.0
    view = WatchView(lambda: now_s)
    assert shown(view).strip() == ""
    view.see(document())
    now_s += 0.5
    assert "stale" not in shown(view)
    now_s += 2.5
    text = shown(view)
    assert "no status from the daemon for 3.0 s" in text
    assert "+0.2500 rad, stale 3.0 s" in text and "OPERATIONAL, stale 3.0 s" in text
    view.see(document())
    assert "stale" not in shown(view)
