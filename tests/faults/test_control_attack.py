"""The control socket under attack, daemon, drive and attackers each in processes of their own.

`servoctl bench --attack` gives the figures themselves; the bounds here are wide, because a busy machine is no finding.
"""

from __future__ import annotations

import statistics
from typing import Any

import pytest

from servod.benchmark.attack import measure, text


@pytest.fixture(scope="module")
def figures() -> dict[str, Any]:
    return measure(quiet_s=1.5, attack_s=1.5, stops=3)


def test_the_loop_wakes_up_as_before(figures: dict[str, Any]) -> None:
    assert figures["median_ratio"] < 3.0
    assert figures["attacked"]["late_share"] < figures["quiet"]["late_share"] + 0.1


def test_a_newcomer_stops_the_axis_whoever_commands_it(figures: dict[str, Any]) -> None:
    """The usual one of several: a single one may have waited for the processor on the way."""
    assert statistics.median(figures["stop_ms"]) < 100.0


def test_what_strangers_send_does_not_fill_the_daemons_memory(figures: dict[str, Any]) -> None:
    assert figures["growth_mib"] < 40.0
    assert "time to stop:     median" in text(figures)
