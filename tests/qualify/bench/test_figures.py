"""How the benchmark turns samples into figures, and figures into verdicts. No figure of this machine is judged."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from servod.cli.common import table_console
from servod.common.errors import BadInput
from servod.qualify.bench import tick, wakeup
from servod.qualify.bench import wall_clock as wall
from servod.qualify.bench.plan import TARGETS, figure, print_table, write_json


def document(**changes: Any) -> dict[str, Any]:
    """A document that meets every target, with whole groups changed."""
    return {
        "machine": {"cpu": "a CPU", "cores": 2, "kernel": "6.1", "python": "3.11"},
        "wakeup": {"median_ratio": 1.0, "p99_ratio": 1.0, "rounds": [{}], "seconds": 10.0},
        "tick_us": {"median": 30.0, "p99": 60.0},
        "controller_us": {"median": 3.0, "p99": 4.0},
        "wall_clock": {"seconds": 59.999, "missed_share": 0.001, "deadline_to_torque_us": 200.0},
        "stepped_speed": 10.0,
        "simulator_speed": 700.0,
        "memory": {"growth_mib": 0.3, "seconds": 600.0},
        "synthesis": {"seconds": 1.5},
        "verification": {"seconds": 50.0, "plants": 1000},
        "commission": {"seconds": 200.0},
    } | changes


def verdicts(**changes: Any) -> dict[str, str]:
    """What the table says of each row that is not simply met."""
    changed = document(**changes)
    return {target.label: target.verdict(changed) for target in TARGETS if target.verdict(changed)}


def test_nothing_is_said_of_targets_that_are_met() -> None:
    assert verdicts() == {}


@pytest.mark.parametrize(
    ("changes", "label"),
    [
        ({"tick_us": {"median": 60.1, "p99": 70.0}}, "whole tick, median"),
        ({"controller_us": {"median": 10.1, "p99": 11.0}}, "controller alone, median"),
        ({"stepped_speed": 4.9}, "stepped, against real time"),
        ({"simulator_speed": 499.0}, "simulator, against real time"),
        ({"memory": {"growth_mib": 1.0, "seconds": 600.0}}, "growth of memory"),
        ({"synthesis": {"seconds": 2.1}}, "synthesis of both regions"),
        ({"verification": {"seconds": 61.0, "plants": 1000}}, "verification with 1000 plants"),
        ({"commission": {"seconds": 241.0}}, "commission"),
    ],
)
def test_a_target_that_is_missed_is_called_so(changes: dict[str, Any], label: str) -> None:
    assert verdicts(**changes) == {label: "missed"}


def test_a_figure_measured_for_too_short_is_not_judged() -> None:
    assert verdicts(memory={"growth_mib": 5.0, "seconds": 120.0}) == {"growth of memory": "not judged (measured 120 s)"}
    short = {"seconds": 10.0, "missed_share": 0.0, "deadline_to_torque_us": 100.0}
    assert verdicts(wall_clock=short) == {"missed periods": "not judged (measured 10 s)"}


def test_a_certificate_of_few_plants_is_not_judged_and_what_was_left_out_is_told() -> None:
    few = {"seconds": 90.0, "plants": 100}
    label = "verification with 1000 plants"
    assert verdicts(verification=few) == {label: "not judged (measured with 100 plants)"}
    assert verdicts(commission=None) == {"commission": "not measured"}


def test_a_document_of_an_earlier_version_is_still_read() -> None:
    earlier = {key: value for key, value in document().items() if key != "synthesis"}
    assert [figure(earlier, target) for target in TARGETS if target.keys[0] == "synthesis"] == [None]


def test_a_missing_cyclictest_is_told_in_the_table(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    missing = {"median_ratio": None, "p99_ratio": None, "rounds": [{}], "seconds": 3.0, "note": "apt install rt-tests"}
    assert figure(document(wakeup=missing), TARGETS[0]) is None
    monkeypatch.delenv("COLUMNS", raising=False)
    print_table(document(wakeup=missing), table_console())
    said = " ".join(capsys.readouterr().out.split())
    assert "Figure Measured Target" in " ".join(re.findall(r"\w+", said))
    assert "apt install rt-tests" in said and "not measured" in said


def test_growth_is_from_the_first_samples_to_the_last() -> None:
    assert wall._growth_mib([1000] * 10 + [5000] * 5 + [3048] * 10) == pytest.approx(2.0)
    assert wall._growth_mib([2048, 1024]) == pytest.approx(-1.0)
    assert wall._growth_mib([2048]) == 0.0


def test_percentile_of_a_histogram() -> None:
    """99 of 100 counts at 3 us, one at 50 us; a count at n stands for the middle of n to n + 1."""
    counts = [(3, 99), (50, 1)]
    assert wakeup._percentile(counts, 0.5) == 3.5
    assert wakeup._percentile(counts, 0.99) == 3.5
    assert wakeup._percentile(counts, 0.995) == 50.5
    assert math.isnan(wakeup._percentile([], 0.5))


def test_lag_counts_skipped_periods_and_leaves_the_warm_up_out() -> None:
    probe = wakeup.LagProbe(wakeup._WARM_UP + 3)
    for _ in range(wakeup._WARM_UP):
        probe.step(0, 900_000, 0)
    for woke_ns, skipped in ((2_000, 0), (1_000, 0), (3_000, 2)):
        assert not probe.finished
        probe.step(0, woke_ns, skipped)
    assert probe.finished
    assert probe.lags_us() == [1.0, 2.0, 2003.0]


def test_ticks_are_counted_without_their_warm_up() -> None:
    times_ns = [9_000_000] * tick._WARM_UP + list(range(1_000, 101_000, 1_000))
    assert tick._figures(times_ns) == {"median": 51.0, "p99": 100.0, "cycles": 100}


class Clock:
    """perf_counter_ns that goes on by itself."""

    def __init__(self) -> None:
        self.now = 0

    def __call__(self) -> int:
        self.now += 7
        return self.now


class Bus:
    """Answers at once and remembers what it was given."""

    counters = SimpleNamespace(sent=3)

    def __init__(self) -> None:
        self.calls: list[tuple[Any, ...]] = []

    def send(self, can_id: int, data: bytes) -> bool:
        self.calls.append((can_id, data))
        return False

    def receive(self, timeout_s: float = 0.0) -> str:
        self.calls.append((timeout_s,))
        return "frame"


def test_the_stopwatch_adds_up_the_time_in_the_bus_and_passes_everything_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tick.time, "perf_counter_ns", Clock())
    bus = Bus()
    stopwatch = tick._Stopwatch(SimpleNamespace(clock=None, connect=lambda _can_ids: bus))
    timed = stopwatch.connect()
    assert timed.send(0x201, b"x") is False
    assert timed.receive(0.5) == "frame"
    assert (bus.calls, stopwatch.spent_ns, timed.counters.sent) == ([(0x201, b"x"), (0.5,)], 14, 3)


def test_the_document_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    file = tmp_path / "bench.json"
    write_json(document(), file)
    assert json.loads(file.read_text()) == document()
    assert list(tmp_path.iterdir()) == [file]
    with pytest.raises(BadInput, match="there is no such folder to write it in"):
        write_json(document(), tmp_path / "nowhere" / "bench.json")
