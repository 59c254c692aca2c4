"""Lost records are counted in what a recorder wrote: holes, and a tail that never came; no recording is no answer."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest

from servod.common.errors import AnswerIsNo
from servod.formats.config import RecorderConfig
from servod.formats.recording.record import FIELDS, RECORD
from servod.qualify.faults.evidence import lost_records, wait_for_rows
from servod.qualify.faults.judge import ReactionTimes
from servod.qualify.faults.run import Outcome, document
from servod.qualify.faults.scenario import Loss
from servod.runtime.daemon.recorder import Recorder

PERIOD_NS = 1_000_000


def rows(cycles: Iterable[int]) -> list[bytes]:
    """One row for each cycle, cycle 1 at 1 ms."""
    rest = [0] * (len(FIELDS) - 2)
    return [RECORD.pack(cycle * PERIOD_NS, cycle, *rest) for cycle in cycles]


@pytest.fixture
def recorder(tmp_path: Path) -> Iterator[Recorder]:
    recorder = Recorder(RecorderConfig(directory=tmp_path, history_s=0.5), "axis", PERIOD_NS // 1000)
    recorder.start().result()
    yield recorder
    recorder.close()


@pytest.mark.parametrize(
    ("cycles", "due_cycle", "lost"),
    [
        (range(1, 101), None, 0),
        (range(1, 101), 90, 0),
        (range(1, 101), 100, 0),
        (range(1, 101), 130, 30),  # the recorder stopped, and said nothing
        ([*range(1, 50), *range(53, 101)], 100, 3),
    ],
)
def test_what_is_missing_is_counted(
    recorder: Recorder, tmp_path: Path, cycles: Iterable[int], due_cycle: int | None, lost: int
) -> None:
    recorder.add_rows(rows(cycles))
    recorder.stop().result()
    assert lost_records(tmp_path, PERIOD_NS, due_cycle and due_cycle * PERIOD_NS) == lost


@pytest.mark.parametrize("due_ns", [None, 100 * PERIOD_NS])
def test_no_recording_and_an_empty_one_are_no_answer(recorder: Recorder, tmp_path: Path, due_ns: int | None) -> None:
    recorder.stop().result()
    for folder in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(AnswerIsNo, match=r"no cycle was recorded, though recorder\.always is set"):
            lost_records(folder, PERIOD_NS, due_ns)


def test_a_recorder_that_runs_is_waited_for_and_one_that_stopped_is_not_for_long(
    recorder: Recorder, tmp_path: Path
) -> None:
    recorder.add_rows(rows(range(1, 11)))
    began_s = time.monotonic()
    wait_for_rows(tmp_path, 50 * PERIOD_NS, timeout_s=0.2)
    assert 0.2 <= time.monotonic() - began_s < 2.0
    later = threading.Timer(0.2, lambda: recorder.add_rows(rows(range(11, 51))))
    later.start()
    wait_for_rows(tmp_path, 50 * PERIOD_NS, timeout_s=20.0)
    later.join()
    assert time.monotonic() - began_s < 20.0 and lost_records(tmp_path, PERIOD_NS, 50 * PERIOD_NS) == 0


def outcome(lost: int | None) -> Outcome:
    """One that passed, with so many lost records."""
    return Outcome(
        name="a",
        title="A",
        group="bus",
        injected="frames",
        detected=(),
        remedy="",
        axis="ENABLED",
        reaction=ReactionTimes(None, None),
        lost_records=lost,
        recovered=True,
        complaints=(),
        loss=Loss.NONE,
    )


def test_only_scenarios_with_a_recorder_tell_of_lost_records() -> None:
    found = document([outcome(None), outcome(2), outcome(0)], 3)
    assert (found["lost_records"], found["recorded"]) == (2, 2)
    assert [scenario["lost_records"] for scenario in found["scenarios"]] == [None, 2, 0]
