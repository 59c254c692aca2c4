"""After a power cut at any moment: all is as before, as after, or readable up to the last second."""

from __future__ import annotations

import json
import random
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from servod.common.errors import BadInput
from servod.common.files import write_bytes, write_file
from servod.formats.config import RecorderConfig
from servod.formats.gains.store import GainStore
from servod.formats.recording.mcap_reader import read_recording
from servod.formats.recording.run_mark import RunMark, abrupt_ends
from servod.lab.commission.state import State, write_text
from servod.runtime.daemon.recorder import Recorder
from tests.formats.gains import good
from tests.power_cut import Cut, Disk
from tests.runtime.daemon.daemon_rows import row


@pytest.fixture
def disk(tmp_path: Path) -> Disk:
    (tmp_path / "disk").mkdir()
    return Disk(tmp_path / "disk")


def _check_all(disk: Disk, folder: Path, check: Callable[[Path, Cut], None], at_least: int) -> None:
    """Lay out every state and look at it."""
    count = 0
    for count, cut in enumerate(disk.states(), start=1):
        at = folder / f"cut{count}"
        at.mkdir()
        check(cut.lay_out(at), cut)
    print(f"{len(disk.log)} operations, {count} states")
    assert count >= at_least


def test_the_harness_sees_what_is_not_synced(disk: Disk) -> None:
    """A file that is replaced as one does without thinking may be empty, gone or cut; one that is synced is not."""
    with disk.watch():
        path = disk.root / "a"
        path.write_text("old")
        aside = disk.root / "a.tmp"
        aside.write_text("new" * 1000)
        aside.replace(path)
    found = {cut.tree.get("a") for cut in disk.states()}
    assert {b"", None, b"old", b"new" * 1000} <= found and len(found) > 5


@pytest.mark.parametrize("write", [write_file, lambda path, text: write_bytes(path, text.encode())])
def test_configuration_certificate_and_model_are_the_old_file_or_the_new(
    write: Callable[[Path, str], object], disk: Disk, tmp_path: Path
) -> None:
    """What `servoctl verify`, `synthesize`, `identify`, `diagnose` and `preset` write goes through these two."""
    texts = ["", good.PD, good.certified_text(), good.LUGRE * 40]
    with disk.watch():
        for n, text in enumerate(texts[1:], start=1):
            write(disk.root / "gains.yaml", text)
            disk.mark(n)

    def check(root: Path, cut: Cut) -> None:
        done = cut.marks[-1] if cut.marks else 0
        path = root / "gains.yaml"
        found = path.read_text() if path.exists() else ""
        assert found in texts[done : done + 2]

    _check_all(disk, tmp_path, check, 20)


def test_the_gain_store_is_as_before_or_as_after(disk: Disk, tmp_path: Path) -> None:
    with disk.watch():
        store = GainStore(disk.root / "var" / "gains")
        for text in (good.PD, good.LUGRE, good.PD.replace("2.5", "3.5")):
            stored = store.load(text, "x")
            disk.mark(("stored", stored.name, stored.version))
            store.activate(stored.name, stored.version)
            disk.mark(("active", stored.name, stored.version))
        back = store.rollback()
        disk.mark(("active", back.name, back.version))
    order = [None, ("bench_pd", 1), ("bench_lugre", 1), ("bench_pd", 2), ("bench_lugre", 1)]

    def check(root: Path, cut: Cut) -> None:
        store = GainStore(root / "var" / "gains")
        active = store.active()
        done = sum(mark[0] == "active" for mark in cut.marks)
        assert (active and (active.name, active.version)) in order[done : done + 2]
        assert store.damage == ""
        there = {("stored", one.name, one.version) for one in store.stored()}
        assert there >= {mark for mark in cut.marks if mark[0] == "stored"}

    _check_all(disk, tmp_path, check, 60)


def test_commissioning_goes_on_where_it_was(disk: Disk, tmp_path: Path) -> None:
    """A step that counts as done has its files as it left them; no state calls a file of the walk somebody else's."""
    names = ["model.yaml", "runs/rows.json"]
    with disk.watch():
        folder = disk.root / "walk"
        write_text(folder / "README", "")  # the folder
        (folder / "README").unlink()
        state = State(folder, {"name": "a"}, names)
        for turn in range(2):
            state.begin("identify", names)
            for name in names:
                write_text(folder / name, f"{turn} {name} " * 50)
            state.record("identify", {"turn": turn}, 1.0, names)
            disk.mark(turn)

    def check(root: Path, cut: Cut) -> None:
        (root / "walk").mkdir(exist_ok=True)
        state = State(root / "walk", {"name": "a"}, names)
        done = [turn for turn in range(2) if state.done("identify", {"turn": turn}, names)]
        for turn in done:
            assert all((root / "walk" / name).read_text() == f"{turn} {name} " * 50 for name in names)
        if cut.marks == (0, 1):
            assert done == [1]

    _check_all(disk, tmp_path, check, 60)


def test_the_mark_of_a_run_is_readable_and_not_lost(disk: Disk, tmp_path: Path) -> None:
    with disk.watch():
        for turn in range(3):
            with RunMark(disk.root / "recordings", "axis"):
                disk.mark(("running", turn))
            disk.mark(("ended", turn))

    def check(root: Path, cut: Cut) -> None:
        path = root / "recordings" / "axis.run.json"
        if not path.exists():
            assert not cut.marks
            return
        abrupt_ends(path, time.time_ns())
        running = json.loads(path.read_text())["running_since_ns"] is not None
        if len(cut.marks) == 6:
            assert not running

    _check_all(disk, tmp_path, check, 20)


def test_recordings_are_readable_up_to_the_last_second_and_saved_fault_files_whole(disk: Disk, tmp_path: Path) -> None:
    given, drawn = 0, random.Random(3)
    with disk.watch():
        recorder = Recorder(RecorderConfig(directory=disk.root / "recordings", history_s=0.3), "axis", 1000)
        recorder.set_attachment("config.yaml", b"name: a\n")
        recorder.start("run.mcap").result(60)
        end = time.monotonic() + 2.6
        while time.monotonic() < end:
            recorder.add_rows([row(given + n, position_rad=drawn.random()) for n in range(20)])
            given += 20
            disk.mark(("given", time.monotonic(), given))
            disk.mark(("told", "", recorder.state()["records"]))
            time.sleep(0.02)
            if given == 1000:
                recorder.add_event("fault", "FOLLOWING_ERROR", code="FOLLOWING_ERROR")
                fault = recorder.write_fault_file("FOLLOWING_ERROR").result(60)
                disk.mark(("saved", str(fault.relative_to(disk.root)), 0))
        recorder.stop().result(60)
        disk.mark(("stopped", "", given))
        recorder.close()

    def check(root: Path, cut: Cut) -> None:
        rounds = [mark for mark in cut.marks if mark[0] == "given"][:-50]  # a second, on a busy machine more
        must = max((m[2] for m in rounds if m[1] < cut.time_s - 1.0), default=0)
        must = max([must, *(mark[2] for mark in cut.marks if mark[0] == "told")])
        stopped = any(mark[0] == "stopped" for mark in cut.marks)
        path = root / "recordings" / "run.mcap"
        try:
            found = read_recording(path)
        except BadInput:
            assert must == 0, must
        else:
            assert list(found.column("cycle")) == list(range(len(found)))
            assert len(found) >= (given if stopped else must)
            assert not (stopped and found.truncated)
        for _, name, _ in (mark for mark in cut.marks if mark[0] == "saved"):
            whole = read_recording(root / name)
            assert not whole.truncated and len(whole) == 300 and whole.events

    _check_all(disk, tmp_path, check, 60)
