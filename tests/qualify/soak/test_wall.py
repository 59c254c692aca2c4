"""A soak of real processes on the wall clock: their recordings, the bus and the drive's record agree."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from servod.qualify.soak.kinds import KINDS
from servod.qualify.soak.launch import DOCUMENT_NAME, run
from servod.qualify.soak.plan import Episode, Move, SoakEnding
from servod.qualify.soak.tally import Wrong
from servod.qualify.soak.wall_clock import WallSoak, of_the_wall
from servod.runtime.loop.commands import ReferenceKind

pytestmark = [pytest.mark.serial, pytest.mark.long]

_KIND = {kind.name: kind for kind in KINDS if of_the_wall(kind)}


def episodes() -> Iterator[Episode]:
    """One that is ridden through, one that stops the axis, one that ends the daemon."""
    move = Move(ReferenceKind.SINE, (0.1, 1.0, 0.6), 0.6)
    for number, name in enumerate(("torque frames lost, a few", "safe torque off", "encoder reset"), start=1):
        yield Episode(number, "demo_pd_dob" if number == 1 else None, move, 0.2, _KIND[name], SoakEnding.FINISH, number)


def test_every_row_of_the_recordings_has_its_sync_and_every_fault_is_seen(tmp_path: Path) -> None:
    axis = WallSoak(1, tmp_path / "w")
    try:
        found = run(axis, episodes(), 10**9, 60.0, tmp_path, lambda _line, _share: None)
    finally:
        axis.close()
    assert found["passed"], found["findings"]
    # On a machine that starves the listener, the hub drops frames and says so; those are told as taken.
    assert found["rows"] == found["syncs"] + found["syncs_taken"] == found["cycles"] - found["missed"] > 2000
    assert (found["faults_due"], found["faults_found"], found["faults_ridden_through"]) == (2, 2, 1)
    assert found["faults_recovered"] == 3
    assert found["recordings"] == 2 and found["restarts"] == 1
    assert {memory["process"] for memory in found["memory"]} == {"soak", "daemon", "virtual axis"}
    assert json.loads((tmp_path / DOCUMENT_NAME).read_text())["rows"] == found["rows"]


def test_a_listener_that_misses_a_sync_is_found(tmp_path: Path) -> None:
    axis = WallSoak(1, tmp_path / "w")
    try:
        axis._heard.count -= 1
        axis.finish()
    finally:
        axis.close()
    assert axis.findings.counts == {Wrong.SYNC: 1} or axis._heard.overruns > 0, axis.findings.anomalies
