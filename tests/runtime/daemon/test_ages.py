"""Every value of the status has an age, and what tells nothing of now is stale: limits.stale_cycles says when."""

from __future__ import annotations

import signal
from pathlib import Path
from typing import Any

import pytest
from daemon_rows import axis_config, record
from running import running, wait_for

from servod.client.control import ControlClient
from servod.runtime.daemon.status import Freshness, drive_status, motion_status
from servod.runtime.fieldbus.devices import NEVER_CYCLES

PERIOD_S = 0.001
LIVE = Freshness(PERIOD_S, stale_cycles=5, record_age_s=0.01)


@pytest.mark.parametrize(
    ("cycles", "age_s", "stale"), [(0, 0.01, False), (4, 0.014, False), (5, 0.015, True), (3200, 3.21, True)]
)
def test_feedback_is_stale_where_the_loop_would_stop_an_axis_for_it(cycles: int, age_s: float, stale: bool) -> None:
    motion, drive = motion_status(record(encoder_age=cycles), LIVE), drive_status(record(amplifier_age=cycles), LIVE)
    for part in (motion, drive):
        assert (part["age_s"], part["stale"]) == (pytest.approx(age_s), stale)


def test_feedback_that_never_came_has_no_age() -> None:
    drive = drive_status(record(amplifier_age=NEVER_CYCLES + 7), LIVE)
    assert (drive["age_s"], drive["stale"]) == (None, True)


def test_a_loop_that_writes_no_cycle_makes_everything_stale() -> None:
    config = axis_config(Path("s"), Path("c"))
    fresh = Freshness.of(config, record(1000, encoder_age=1), now_ns=3_500_000_000)
    assert fresh.record() == {"age_s": 2.5, "stale": True}
    assert fresh.feedback(1) == {"age_s": pytest.approx(2.501), "stale": True}
    assert not Freshness.of(config, record(1000), now_ns=1_100_000_000).record()["stale"]


def ages(client: ControlClient) -> dict[str, dict[str, Any]]:
    """The parts of the status that have an age."""
    status = client.call("status")
    nodes = {f"node {node['node_id']}": node for node in status["nodes"]}
    return {"motion": status["motion"], "drive": status["drive"], "loop": status["loop"], **nodes}


def test_a_bus_that_dies_shows_in_the_status(tmp_path: Path) -> None:
    with running(tmp_path) as axis, ControlClient(axis.socket) as client:
        wait_for(lambda: not any(part["stale"] for part in ages(client).values()))
        assert max(part["age_s"] for part in ages(client).values()) < 1.0
        axis.axis.send_signal(signal.SIGSTOP)
        try:
            gone = {"motion", "drive", "node 1", "node 2"}
            wait_for(lambda: {name for name, part in ages(client).items() if part["stale"]} == gone)
            before = ages(client)
            wait_for(lambda: all(ages(client)[name]["age_s"] > before[name]["age_s"] + 0.2 for name in gone))
        finally:
            axis.axis.send_signal(signal.SIGCONT)
