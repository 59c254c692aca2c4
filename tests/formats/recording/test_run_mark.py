"""The mark of a run: what it tells after every kind of end, and that it neither lies nor grows."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from servod.common.errors import BadInput, Unreachable
from servod.common.portable import is_locked
from servod.formats.recording import run_mark
from servod.formats.recording.run_mark import MOST_ENDS, AbruptEnd, RunMark, abrupt_ends

CHILD = """
import sys, time
from pathlib import Path
from servod.formats.recording import run_mark
run_mark.SIGN_S = 0.05
with run_mark.RunMark(Path(sys.argv[1]), "joint"):
    print("begun", flush=True)
    time.sleep(60)
"""


def file_of(folder: Path) -> Path:
    return folder / "joint.run.json"


def ends(folder: Path) -> list[AbruptEnd]:
    return abrupt_ends(file_of(folder), time.time_ns())


def killed(folder: Path, alive_s: float = 0.0) -> None:
    """A run that ends by kill -9."""
    with subprocess.Popen([sys.executable, "-c", CHILD, str(folder)], stdout=subprocess.PIPE) as child:
        assert child.stdout is not None and child.stdout.readline() == b"begun\n"
        time.sleep(alive_s)
        assert ends(folder) == []  # it lives
        child.send_signal(signal.SIGKILL)


@pytest.mark.parametrize("raised", [None, Unreachable("no bus"), KeyboardInterrupt()], ids=["end", "error", "Ctrl-C"])
def test_an_end_that_was_meant_tells_nothing(raised: BaseException | None, tmp_path: Path) -> None:
    try:
        with RunMark(tmp_path, "joint"):
            assert ends(tmp_path) == []
            if raised:
                raise raised
    except (Unreachable, KeyboardInterrupt):
        pass
    assert ends(tmp_path) == [] and RunMark(tmp_path, "joint").found is None
    assert [path.name for path in tmp_path.iterdir()] == ["joint.run.json"]


def test_a_killed_run_is_told_at_once_and_kept_by_the_next_start_once(tmp_path: Path) -> None:
    before_ns = time.time_ns()
    killed(tmp_path, alive_s=0.3)
    (found,) = ends(tmp_path)
    assert before_ns + 200_000_000 <= found.seen_ns <= found.found_ns <= time.time_ns()  # later than its start
    for _ in range(2):
        with RunMark(tmp_path, "joint") as mark:
            kept = ends(tmp_path)
            assert [end.seen_ns for end in kept] == [found.seen_ns]
        assert mark.found is None or mark.found == kept[0]
    assert ends(tmp_path) == kept


def test_an_error_that_nobody_foresaw_is_no_orderly_end(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), RunMark(tmp_path, "joint"):
        raise ZeroDivisionError
    assert len(ends(tmp_path)) == 1


def test_a_copy_of_a_mark_is_of_no_run(tmp_path: Path) -> None:
    """Recordings that are copied from a running machine, or from a dead one, tell nothing that is not theirs."""
    copy = tmp_path / "copy.run.json"
    with RunMark(tmp_path, "joint"):
        copy.write_bytes(file_of(tmp_path).read_bytes())
        assert abrupt_ends(copy, time.time_ns()) == []
    with pytest.raises(ZeroDivisionError), RunMark(tmp_path, "joint"):
        raise ZeroDivisionError
    copy.write_bytes(file_of(tmp_path).read_bytes())
    assert (abrupt_ends(copy, time.time_ns()), len(ends(tmp_path))) == ([], 1)


def test_an_orderly_end_while_one_looks_is_orderly(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = RunMark(tmp_path, "joint").__enter__()

    def ended_meanwhile(descriptor: int) -> bool:
        monkeypatch.setattr(run_mark, "is_locked", is_locked)
        run.__exit__(None, None, None)
        return is_locked(descriptor)

    monkeypatch.setattr(run_mark, "is_locked", ended_meanwhile)
    assert ends(tmp_path) == []


def test_old_ends_make_room(tmp_path: Path) -> None:
    for number in range(MOST_ENDS + 5):
        with pytest.raises(ZeroDivisionError), RunMark(tmp_path, "joint"):
            raise ZeroDivisionError(number)
    with RunMark(tmp_path, "joint"):
        pass
    kept = ends(tmp_path)
    assert len(kept) == MOST_ENDS and kept == sorted(kept, key=lambda end: end.seen_ns)
    assert len(list(tmp_path.iterdir())) == 1 and file_of(tmp_path).stat().st_size < 4096


def test_a_write_that_the_power_cuts_leaves_the_mark_of_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """The file aside is whole on the disk before it takes the place of the other one."""
    written: list[str] = []
    monkeypatch.setattr(run_mark.os, "fsync", lambda _: written.append("fsync"))
    replace = Path.replace
    monkeypatch.setattr(Path, "replace", lambda path, other: (written.append("rename"), replace(path, other))[1])
    monkeypatch.setattr(run_mark, "flush_folder", lambda _: written.append("folder"))
    with RunMark(tmp_path, "joint"):
        assert written == ["fsync", "rename", "folder"]
        file_of(tmp_path).with_name("joint.run.json.part").write_text('{"running_si')
        assert ends(tmp_path) == []

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(run_mark.os, "fsync", full)
    with RunMark(tmp_path, "joint") as mark:
        assert mark.found is None
    assert "no mark of this run (no space left on device)" in caplog.text and ends(tmp_path) == []


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "[]",
        '{"abrupt_ends": 1}',
        '{"running_since_ns": "x"}',
        '{"more": 1}',
        '{"running_since_ns": 99999999999999999999999999}',
        '{"abrupt_ends": [{"seen_ns": -9, "found_ns": 3}]}',
        "x" * 100_000,
    ],
)
def test_a_damaged_mark_is_bad_input_and_begun_anew(text: str, tmp_path: Path) -> None:
    file_of(tmp_path).write_text(text)
    with pytest.raises(BadInput, match=r"joint\.run\.json"):
        ends(tmp_path)
    with RunMark(tmp_path, "joint") as mark:
        assert mark.found is None and ends(tmp_path) == []


def test_two_axes_of_one_name_do_not_tell_of_one_another(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with RunMark(tmp_path, "joint"):
        with RunMark(tmp_path, "joint") as second:
            assert second.found is None and "another servod holds it" in caplog.text
        assert json.loads(file_of(tmp_path).read_text())["running_since_ns"] is not None
    assert ends(tmp_path) == []


def test_two_who_look_at_once_do_not_take_one_another_for_the_daemon(tmp_path: Path) -> None:
    killed(tmp_path)
    with file_of(tmp_path).open() as other:
        assert not is_locked(other.fileno())  # it looks, and has not closed the file
        assert len(ends(tmp_path)) == 1
        with RunMark(tmp_path, "joint") as mark:
            assert mark.found is not None


def test_a_clock_that_was_set_back_gives_no_negative_time(tmp_path: Path) -> None:
    killed(tmp_path)
    later = time.time() + 3600.0
    os.utime(file_of(tmp_path), (later, later))
    (found,) = ends(tmp_path)
    assert found.found_ns >= found.seen_ns
