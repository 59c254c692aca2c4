"""The control socket under attack, daemon, drive and attackers each in processes of their own.

`servoctl bench --attack` gives the figures themselves. A busy machine stalls for some milliseconds now and then, and
not longer under attack than without: each round is held against its own part without an attack, and what one of three
rounds reaches is the daemon's, what the others miss is the machine's.
"""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from servod.common.errors import AnswerIsNo
from servod.qualify.bench.attack import measure, text, told
from servod.qualify.bench.attackers import SILENT

pytestmark = pytest.mark.alone

STOPS, ROUNDS = 3, 3


@pytest.fixture(scope="module")
def figures() -> dict[str, Any]:
    return measure(quiet_s=1.5, attack_s=1.5, stops=STOPS, rounds=ROUNDS)


def best(figures: dict[str, Any], key: str) -> float:
    return float(min(one[key] for one in figures["rounds"]))


@pytest.mark.wall_clock
def test_the_loop_wakes_up_as_before(figures: dict[str, Any]) -> None:
    """Median, tail, and cycles that were late by more than a period."""
    assert len(figures["rounds"]) == ROUNDS
    assert best(figures, "median_ratio") < 1.5, text(figures)
    assert best(figures, "p99_ratio") < 2.0, text(figures)
    assert best(figures, "more_late_share") < 0.01, text(figures)


@pytest.mark.wall_clock
def test_a_newcomer_stops_the_axis_whoever_commands_it(figures: dict[str, Any]) -> None:
    """The usual stop of all, and every stop of one round."""
    rounds = [one["stop_ms"] for one in figures["rounds"]]
    assert [len(stops) for stops in rounds] == [STOPS] * ROUNDS
    assert statistics.median(ms for stops in rounds for ms in stops) < 100.0, text(figures)
    assert min(map(max, rounds)) < 100.0, text(figures)


def test_what_strangers_send_does_not_fill_the_daemons_memory(figures: dict[str, Any]) -> None:
    assert figures["growth_mib"] < 40.0
    assert "time to stop:     median" in text(figures)


def test_every_attack_took_place(figures: dict[str, Any]) -> None:
    attacks = figures["attacks"]
    assert attacks["idle"]["connections"] >= 200 * ROUNDS
    assert all(did["connections"] and (did["bytes"] or name in SILENT) for name, did in attacks.items())
    assert "come_and_go" in text(figures)


def test_attackers_without_a_daemon_say_that_they_did_nothing(tmp_path: Path) -> None:
    nowhere = [sys.executable, "-m", "servod.qualify.bench.attackers", str(tmp_path / "none.sock"), "0.1"]
    done = subprocess.run(nowhere, capture_output=True, text=True, timeout=30)
    assert done.returncode == 1 and set(json.loads(done.stdout.splitlines()[-1])) >= {"idle", "flood", "endless"}
    (tmp_path / "log").write_text(done.stdout)
    with pytest.raises(AnswerIsNo, match="no attack of these kinds took place: idle, deaf, half, garbage"):
        told(tmp_path / "log")


def test_one_kind_of_attack_that_said_nothing_is_missed(figures: dict[str, Any], tmp_path: Path) -> None:
    log = tmp_path / "log"
    log.write_text(json.dumps(figures["attacks"]))
    assert set(told(log)) == set(figures["attacks"])
    log.write_text(json.dumps(figures["attacks"] | {"nested": {"connections": 3, "bytes": 0}}))
    with pytest.raises(AnswerIsNo, match="took place: nested"):
        told(log)
    log.write_text("a traceback")
    with pytest.raises(AnswerIsNo, match="did not tell what they did: a traceback"):
        told(log)
