"""The control socket under attack, daemon, drive and attackers each in processes of their own.

`servoctl bench --attack` gives the figures themselves. What a busy machine does to a stop stands in the same run's
stops without an attack; the bound of 100 ms holds for what goes beyond that.
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
    """Every one of them, and not only the usual one."""
    quiet_ms, attacked_ms = figures["quiet_stop_ms"], figures["stop_ms"]
    assert len(quiet_ms) == len(attacked_ms) == 3
    assert statistics.median(attacked_ms) < 100.0
    assert max(attacked_ms) < max(100.0, 2.0 * max(quiet_ms)), (quiet_ms, attacked_ms)


def test_what_strangers_send_does_not_fill_the_daemons_memory(figures: dict[str, Any]) -> None:
    assert figures["growth_mib"] < 40.0
    assert "time to stop:     median" in text(figures)
