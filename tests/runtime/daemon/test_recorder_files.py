"""What a recorder's files survive: a full disk, a slow one, a folder that goes; and how many of them are kept."""

from __future__ import annotations

import os
import random
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from daemon_rows import row, rows
from running import CONFIG

from servod.client.processes import child, wait_until
from servod.common.errors import BadInput, Unreachable
from servod.common.shipped import shipped
from servod.formats.config import RecorderConfig
from servod.formats.recording.mcap_reader import read_recording
from servod.runtime.daemon.recorder import MIB, Recorder


def _recorder(directory: Path, **keys: Any) -> Recorder:
    return Recorder(RecorderConfig(directory=directory, **keys), "axis", 1000)


def _until(reached: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 10.0
    while not reached():
        assert time.monotonic() < deadline, "nothing came"
        time.sleep(0.01)


def _noise(first: int, count: int, drawn: random.Random) -> list[bytes]:
    """Rows that no packing makes much smaller."""
    return [row(first + n, position_rad=drawn.random(), torque_nm=drawn.random()) for n in range(count)]


@contextmanager
def _files_of_at_most(size: int) -> Iterator[None]:
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("size", [60_000, 100_000, 123_456, 300_000])
def test_after_a_full_disk_records_and_dropped_are_what_the_file_has_and_lacks(tmp_path: Path, size: int) -> None:
    recorder, drawn, given = _recorder(tmp_path), random.Random(size), 0
    with _files_of_at_most(size):
        path = recorder.start("full.mcap").result(5)
        while recorder.state()["recording"]:
            recorder.add_rows(_noise(given, 100, drawn))
            given += 100
            time.sleep(0.002)
        for _ in range(3):  # it goes on counting: these cycles are in no file either
            recorder.add_rows(_noise(given, 100, drawn))
            given += 100
        _until(lambda: recorder.state()["records"] + recorder.state()["dropped"] == given)
    state = recorder.state()
    recorder.close()
    assert state["dropped"] > 0 and "too large" in state["failure"]
    assert len(read_recording(path)) == state["records"]


def test_a_slow_disk_holds_up_the_writing_thread_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """There is no slow disk at hand: every sync of a file takes 0.7 s here."""
    fsync = os.fsync

    def slow(descriptor: int) -> None:
        time.sleep(0.7)
        fsync(descriptor)

    recorder = _recorder(tmp_path)
    recorder.start("slow.mcap").result(5)
    monkeypatch.setattr(os, "fsync", slow)
    longest_s = 0.0
    for first in range(0, 2000, 20):
        began = time.monotonic()
        recorder.add_rows(rows(20, first))
        recorder.state()
        longest_s = max(longest_s, time.monotonic() - began)
        time.sleep(0.02)
    assert longest_s < 0.3
    state = recorder.stop().result(10)
    recorder.close()
    assert (state["records"], state["dropped"]) == (2000, 0)
    assert len(read_recording(tmp_path / "slow.mcap")) == 2000


@pytest.mark.parametrize("wait_s", [0.0, 1.2])
def test_a_folder_that_was_deleted_is_told_at_the_stop_and_before(tmp_path: Path, wait_s: float) -> None:
    folder = tmp_path / "recordings"
    recorder = _recorder(folder)
    recorder.start().result(5)
    recorder.add_rows(rows(100))
    shutil.rmtree(folder)
    time.sleep(wait_s)
    if wait_s:
        assert "deleted or moved" in recorder.take_failure() and not recorder.state()["recording"]
    with pytest.raises(Unreachable, match=r"axis-.*\.mcap: the file was deleted or moved while it was recorded"):
        recorder.stop().result(5)
    assert recorder.state()["records"] == 0 and recorder.state()["dropped"] == 100
    again = recorder.start().result(5)  # the folder is made again
    recorder.add_rows(rows(10))
    assert recorder.stop().result(5)["records"] == 10
    recorder.close()
    assert len(read_recording(again)) == 10


def test_the_oldest_recordings_make_room_and_no_fault_file_does(tmp_path: Path) -> None:
    mine = tmp_path / "run.mcap"
    mine.write_bytes(bytes(MIB))
    faults = [tmp_path / f"axis-fault-2020010{day}-000000-DRIVE_FAULT.mcap" for day in (1, 2, 3)]
    for age, path in enumerate(faults):
        path.write_bytes(bytes(MIB // 4))
        os.utime(path, (1000 + age, 1000 + age))
    recorder = _recorder(tmp_path, max_total_mib=4, max_fault_files=2)
    drawn, given = random.Random(1), 0
    first = recorder.start().result(5)
    while recorder.state()["removed"] < 3:  # a fault file and two parts
        recorder.add_rows(_noise(given, 500, drawn))
        given += 500
        time.sleep(0.004)
        kept = [path for path in tmp_path.glob("axis-*.mcap") if path.exists()]
        assert sum(path.stat().st_size for path in kept if path.exists()) <= 4.2 * MIB
    state = recorder.stop().result(5)
    recorder.close()
    assert state["records"] == given and state["total_bytes"] <= 4 * MIB
    assert not first.exists() and mine.exists()
    assert [path.exists() for path in faults] == [False, True, True]
    names = sorted(tmp_path.glob("axis-2*.mcap"), key=lambda path: path.stat().st_mtime_ns)
    cycles = [cycle for path in names for cycle in read_recording(path).column("cycle")]
    assert cycles == list(range(cycles[0], given)) and cycles[0] > 0


def test_no_part_grows_beyond_its_share_however_fast_the_rows_come(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Far more between two syncs than a part has room for; a chunk in progress comes on top."""
    monkeypatch.setattr("servod.runtime.daemon.recorder.SYNC_PERIOD_S", 60.0)
    recorder, drawn = _recorder(tmp_path, max_total_mib=8), random.Random(2)
    recorder.start().result(5)
    for first in range(0, 60_000, 500):
        recorder.add_rows(_noise(first, 500, drawn))
    assert recorder.stop().result(30)["records"] == 60_000
    recorder.close()
    sizes = [path.stat().st_size for path in tmp_path.glob("axis-*.mcap")]
    assert len(sizes) > 1 and max(sizes) <= 2.1 * MIB


def test_recordings_that_are_too_old_go_at_the_start(tmp_path: Path) -> None:
    old, new, named, fault = (
        tmp_path / name
        for name in (
            "axis-20200101-000000.mcap",
            "axis-20200102-000000-2.mcap",
            "axis-run.mcap",
            "axis-fault-20200101-000000-BUS_OFF.mcap",
        )
    )
    for path in (old, new, named, fault):
        path.write_bytes(b"x")
    for path in (old, named, fault):
        os.utime(path, (1000, 1000))
    recorder = _recorder(tmp_path, max_age_days=1.0)
    _until(lambda: recorder.state()["removed"] == 1)
    recorder.close()
    assert [path.exists() for path in (old, new, named, fault)] == [False, True, True, True]


@pytest.mark.serial
@pytest.mark.parametrize(("kib", "line"), [(64, "shared memory for the loop cannot be made"), (0, "gain store")])
def test_a_daemon_that_may_write_no_large_files_ends_with_one_line(tmp_path: Path, kib: int, line: str) -> None:
    config, bus = tmp_path / "axis.yaml", tmp_path / "bus"
    config.write_text(CONFIG.format(folder=tmp_path, gains=shipped("gains/demo_pd.yaml"), travel_rad=0.6))
    with child("servod.drivers.virtual.main", ["--socket", str(bus)], tmp_path / "axis.log") as axis:
        wait_until(bus.exists, axis, tmp_path / "axis.log", 30.0)
        with _files_of_at_most(1024 * kib):
            ended = subprocess.run(
                [sys.executable, "-m", "servod.runtime.daemon.main", "--config", str(config)],
                capture_output=True,
                text=True,
                timeout=60,
            )
    assert "Traceback" not in ended.stderr and ended.returncode in (2, 3)
    last = ended.stderr.splitlines()[-1]
    assert last.startswith("servod: ") and line in last and "file too large" in last.lower()


@pytest.mark.parametrize("name", ["fault-20990101-000000-OSCILLATES", "fault-20990101-000000", "20990101-000000"])
def test_no_client_gives_a_recording_the_name_of_one_that_makes_room(tmp_path: Path, name: str) -> None:
    """Enough of them, or of their parts, would push the seconds before a real fault out."""
    recorder, name = _recorder(tmp_path), f"axis-{name}.mcap"
    with pytest.raises(BadInput, match="a name that servod does not give its own files"):
        recorder.start(name).result(5)
    recorder.start("other-" + name).result(5)
    recorder.close()
    assert [path.name for path in tmp_path.iterdir()] == ["other-" + name]
