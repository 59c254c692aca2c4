"""The whole benchmark with a tiny plan: every measurement runs and the document has its keys. No figure is judged."""

from __future__ import annotations

import json
import math

import pytest

from servod.cli.common import table_console
from servod.qualify.bench import QUICK, THOROUGH, BenchSettings, measure
from servod.qualify.bench.plan import TARGETS, figure, print_table

pytestmark = pytest.mark.serial

TINY = BenchSettings(
    wakeup_s=0.5, wakeup_rounds=1, ticks=50, wall_clock_s=0.5, memory_s=0.5, stepped_s=0.5, simulated_s=0.5, plants=1
)


def test_the_document_has_every_key_and_a_finite_figure_for_each(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    told: list[str] = []
    document = json.loads(json.dumps(measure(TINY, told.append), allow_nan=False))
    assert len(told) == 5
    assert {"median_ratio", "p99_ratio"} <= set(document["wakeup"])
    assert {"median", "p99"} <= set(document["tick_us"])
    assert {"median", "p99"} <= set(document["controller_us"])
    assert {"seconds", "missed_share", "deadline_to_torque_us"} <= set(document["wall_clock"])
    assert "growth_mib" in document["memory"]
    assert document["verification"]["plants"] == 1 and document["commission"] is None
    assert document["stepped_speed"] > 0.0 and document["simulator_speed"] > 0.0
    figures = [figure(document, target) for target in TARGETS]
    assert all(value is None or math.isfinite(value) for value in figures)
    assert document["memory"]["seconds"] == TINY.memory_s
    monkeypatch.delenv("COLUMNS", raising=False)
    print_table(document, table_console())
    assert "not judged (measured 0.5 s)" in " ".join(capsys.readouterr().out.split())


def test_the_thorough_plan_is_long_enough_for_every_target() -> None:
    longest = {target.keys[0]: target.seconds for target in TARGETS if target.seconds}
    assert longest == {"wall_clock": THOROUGH.wall_clock_s, "memory": THOROUGH.memory_s}
    assert QUICK.memory_s < longest["memory"]
