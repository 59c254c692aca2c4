"""A disk that takes no more: one line names the file, and nothing that is empty or half written stays behind."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from servod.common.errors import BadInput
from servod.common.files import refusal_of, write_bytes
from servod.formats.recording.mcap_writer import write_whole
from servod.formats.recording.run_mark import RunMark
from servod.lab.commission.comparison import save_rows
from servod.lab.identify.store import Recordings
from servod.lab.identify.trace import ExperimentKind, RecordedMotion
from servod.lab.recordings.recording import rows_of
from servod.qualify.blind.conceal import CASES
from servod.qualify.blind.examine import Examiner
from tests.runtime.daemon.daemon_rows import rows

ROWS = rows_of(b"".join(rows(50)))
NONE = np.zeros(0)
MOTION = RecordedMotion(next(iter(ExperimentKind)), NONE, NONE, NONE, NONE, NONE, NONE, NONE)


def marked(folder: Path) -> None:
    with RunMark(folder, "joint"):
        pass


#: What writes into a folder, and how often it has something on the disk before all is well.
WRITERS: dict[str, tuple[Callable[[Path], object], int]] = {
    "file in new folders": (lambda folder: write_bytes(folder / "a/b/file.json", b"{}"), 3),
    "recording": (lambda folder: write_whole(folder / "run.mcap", rows(50), 0), 3),
    "run of a commissioning": (lambda folder: save_rows(folder / "run.mcap", ROWS), 3),
    "experiment": (lambda folder: Recordings(folder).keep(ROWS, MOTION), 4),
    "mark of a run": (marked, 1),
}
STEPS = [(name, step) for name, (_, steps) in WRITERS.items() for step in range(steps)]


@pytest.mark.parametrize(("name", "step"), STEPS, ids=[f"{name}, {step}" for name, step in STEPS])
def test_a_full_disk_keeps_nothing(name: str, step: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done, to_disk = list[int](), os.fsync

    def fsync(descriptor: int) -> None:
        done.append(descriptor)
        if len(done) > step:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        to_disk(descriptor)

    monkeypatch.setattr(os, "fsync", fsync)
    try:
        WRITERS[name][0](tmp_path)
    except (BadInput, OSError) as error:
        assert not isinstance(error, BadInput) or str(error).endswith("cannot be written: the disk is full")
    assert len(done) > step and list(tmp_path.rglob("*")) == []


def test_a_diagnosis_that_finds_the_disk_full_names_its_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    case = tmp_path / CASES / "c000"
    case.mkdir(parents=True)
    (case / "model.yaml").touch()

    def full(_descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(BadInput, match=r"case/model\.yaml: cannot be written: the disk is full"):
        Examiner(tmp_path, 5.0).run(1, lambda _name, _done, _of: None)
    assert [entry.name for entry in tmp_path.iterdir()] == [CASES]


def test_folders_above_one_that_cannot_be_made_are_taken_away(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="the name is too long"):
        write_bytes(tmp_path / "new" / (300 * "n") / "file", b"")
    assert "name too long" in refusal_of(tmp_path / "new" / (300 * "n"))
    assert not list(tmp_path.iterdir())
