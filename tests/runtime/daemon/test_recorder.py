import os
import random
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path

import pytest
from daemon_rows import row, rows
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from servod.common.errors import BadInput, Unreachable
from servod.formats.config import RecorderConfig
from servod.formats.recording.mcap_reader import read_recording
from servod.formats.recording.mcap_writer import CYCLE_TOPIC, McapFile, split_rows
from servod.formats.recording.record import CycleRecord
from servod.runtime.daemon.recorder import HistoryRing, Recorder, _resolve


def _recorder(directory: Path, history_s: float = 1.0) -> Recorder:
    return Recorder(RecorderConfig(directory=directory, history_s=history_s), "axis", 1000)


def test_a_folder_that_takes_no_file_is_told_before_anything_is_recorded(tmp_path: Path) -> None:
    good, bad = _recorder(tmp_path / "new"), _recorder(tmp_path / "a file" / "recordings")
    (tmp_path / "a file").touch()
    for recorder in (good, bad):
        recorder.try_folder()
        recorder.close()
    assert good.take_failure() == "" and list((tmp_path / "new").iterdir()) == []
    assert "no file can be written there" in bad.take_failure()
    assert "no file can be written there" in bad.state()["failure"]


def test_recording_gives_back_rows_events_and_attachments(tmp_path: Path) -> None:
    recorder = _recorder(tmp_path)
    recorder.set_attachment("config.yaml", b"name: a\n")
    path = recorder.start("run.mcap").result(5)
    for first in range(0, 1000, 20):
        recorder.add_rows(rows(20, first))
    recorder.add_event("fault", "it happened", code="DRIVE_FAULT")
    recorder.set_attachment("gains.yaml", b"law: pd\n")
    assert recorder.stop().result(5)["records"] == 1000
    recorder.close()
    recording = read_recording(path)
    assert not recording.truncated
    assert recording.names == CycleRecord._fields
    assert [r.cycle for r in recording.records()] == list(range(1000))
    assert recording.column("position_rad")[7] == 0.007
    assert recording.attachments == {"config.yaml": b"name: a\n", "gains.yaml": b"law: pd\n"}
    assert [(e["kind"], e["code"]) for e in recording.events] == [("fault", "DRIVE_FAULT")]


def test_recording_that_is_full_goes_on_in_a_new_file(tmp_path: Path) -> None:
    recorder = Recorder(RecorderConfig(directory=tmp_path, max_file_mib=1), "axis", 1000)
    recorder.set_attachment("config.yaml", b"name: a\n")
    recorder.start("run.mcap").result(5)
    noise, count = random.Random(1), 0
    while recorder.state()["path"] in ("", str(tmp_path / "run.mcap")):
        recorder.add_rows([row(count + n, position_rad=noise.random(), torque_nm=noise.random()) for n in range(500)])
        count += 500
        time.sleep(0.01)
    assert recorder.stop().result(5)["records"] == count
    recorder.close()
    parts = [read_recording(tmp_path / name) for name in ("run.mcap", "run-2.mcap")]
    assert [r.cycle for part in parts for r in part.records()] == list(range(count))
    assert [part.attachments for part in parts] == [{"config.yaml": b"name: a\n"}] * 2
    assert recorder.state()["bytes"] >= 1024 * 1024


def test_only_the_newest_fault_files_are_kept_and_nothing_else_is_touched(tmp_path: Path) -> None:
    others = ["axis-20260101-000000.mcap", "axis-fault-mine.mcap", "axis-fault-x-fault-20260101-000000-A.mcap"]
    for name in others:
        (tmp_path / name).write_bytes(b"")
    for age in range(5):
        path = tmp_path / f"axis-fault-2026010{age + 1}-000000-FOLLOWING_ERROR.mcap"
        path.write_bytes(b"")
        os.utime(path, (1000 + age, 1000 + age))
    recorder = Recorder(RecorderConfig(directory=tmp_path, max_fault_files=3), "axis", 1000)
    recorder.add_rows(rows(10))
    newest = recorder.write_fault_file("DRIVE_FAULT").result(5)
    recorder.close()
    kept = {path.name for path in tmp_path.iterdir()} - set(others)
    assert kept == {newest.name, *(f"axis-fault-2026010{day}-000000-FOLLOWING_ERROR.mcap" for day in (4, 5))}
    assert all((tmp_path / name).exists() for name in others)


def test_ordinary_mcap_readers_find_their_way_by_the_index(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    file = McapFile(path, {"model.yaml": b"inertia: 1\n"}, offset_ns=10**18)
    for first in range(0, 5000, 500):
        file.write_rows(rows(500, first))
        file.sync()
    file.close()
    with path.open("rb") as stream:
        reader = make_reader(stream)
        summary = reader.get_summary()
        assert summary is not None
        assert len(summary.chunk_indexes) == 10
        assert summary.statistics is not None
        assert summary.statistics.message_count == 5000
        start_ns = 10**18 + 4_000 * 1_000_000
        late = [m.log_time for _, _, m in reader.iter_messages([CYCLE_TOPIC], starting_at=start_ns)]
    assert late == [start_ns + n * 1_000_000 for n in range(1000)]


def test_ros2_decoder_reads_the_records(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    file = McapFile(path, {}, 0)
    file.write_rows([row(5, torque_nm=-0.25, status_word=0x1237)])
    file.close()
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        ((_, _, _, message),) = list(reader.iter_decoded_messages([CYCLE_TOPIC]))
    assert (message.cycle, message.torque_nm, message.status_word) == (5, -0.25, 0x1237)


@pytest.mark.parametrize("cut", [9, 100, 5000, 30_000])
def test_file_cut_off_anywhere_keeps_what_was_before(tmp_path: Path, cut: int) -> None:
    whole = tmp_path / "whole.mcap"
    file = McapFile(whole, {}, 0)
    for first in range(0, 2000, 100):
        file.write_rows(rows(100, first))
        file.sync()
    file.close()
    short = tmp_path / "short.mcap"
    short.write_bytes(whole.read_bytes()[:-cut])
    recording = read_recording(short)
    assert recording.truncated
    cycles = list(recording.column("cycle"))
    assert cycles == list(range(len(cycles)))
    assert len(cycles) % 100 == 0
    assert len(cycles) >= (2000 if cut <= 5000 else 100)


@pytest.mark.parametrize("content", [b"", b"t_s,torque_nm\n0,1\n" * 20, b"\x89MCAP0\r\n" + bytes(100)])
def test_what_is_no_recording_is_bad_input(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    with pytest.raises(BadInput, match=r"x\.mcap"):
        read_recording(path)
    with pytest.raises(BadInput, match="there is no such file"):
        read_recording(tmp_path / "missing.mcap")


_WRITER = """
import sys, time
from pathlib import Path
from servod.formats.config import RecorderConfig
from servod.runtime.daemon.recorder import Recorder
from daemon_rows import row
recorder = Recorder(RecorderConfig(directory=Path(sys.argv[1]), history_s=0.1), "axis", 1000)
print(recorder.start("killed.mcap").result(), flush=True)
cycle = 0
while True:
    time.sleep(0.02)
    recorder.add_rows([row(cycle + n, time_ns=time.monotonic_ns()) for n in range(20)])
    cycle += 20
"""


@pytest.mark.parametrize("seed", range(3))
def test_kill_9_loses_less_than_a_second(tmp_path: Path, seed: int) -> None:
    env = {**os.environ, "PYTHONPATH": str(Path(__file__).parent)}
    command = [sys.executable, "-c", _WRITER, str(tmp_path)]
    child = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=env)
    assert child.stdout is not None
    path = child.stdout.readline().strip()
    time.sleep(random.Random(seed).uniform(0.7, 1.6))
    killed_ns = time.monotonic_ns()
    os.kill(child.pid, signal.SIGKILL)
    child.wait(10)
    child.stdout.close()
    recording = read_recording(path)
    assert recording.truncated
    assert killed_ns - recording.column("time_ns")[-1] < 1_000_000_000
    assert list(recording.column("cycle")) == list(range(len(recording)))


def test_fault_file_starts_before_the_fault(tmp_path: Path) -> None:
    recorder = _recorder(tmp_path, history_s=0.5)
    recorder.set_attachment("config.yaml", b"x: 1\n")
    recorder.add_rows(rows(3000))
    recorder.add_event("fault", "FOLLOWING_ERROR")
    path = recorder.write_fault_file("FOLLOWING_ERROR").result(5)
    recorder.close()
    recording = read_recording(path)
    assert "FOLLOWING_ERROR" in path.name
    assert list(recording.column("cycle")) == list(range(2500, 3000))
    assert recording.attachments["config.yaml"] == b"x: 1\n"
    assert recording.events[0]["text"] == "FOLLOWING_ERROR"


def test_two_fault_files_of_one_second_do_not_collide(tmp_path: Path) -> None:
    recorder = _recorder(tmp_path)
    paths = {recorder.write_fault_file("BUS_OFF").result(5) for _ in range(3)}
    recorder.close()
    assert len(paths) == 3


def test_full_disk_ends_the_recording_and_nothing_else(tmp_path: Path) -> None:
    recorder = _recorder(tmp_path)
    path = recorder.start("full.mcap").result(5)
    full = os.open("/dev/full", os.O_WRONLY)
    descriptor = next(d for d in Path("/proc/self/fd").iterdir() if _points_to(d, path))
    os.dup2(full, int(descriptor.name))
    os.close(full)
    recorder.add_rows(rows(5000))
    failure = _wait_for(recorder.take_failure)
    assert "No space left" in failure
    assert recorder.take_failure() == ""
    assert recorder.state()["recording"] is False
    assert "No space left" in recorder.state()["failure"]
    again = recorder.start("again.mcap").result(5)
    recorder.add_rows(rows(10))
    assert recorder.stop().result(5)["failure"] == ""
    recorder.close()
    assert len(read_recording(again)) == 10


def _points_to(descriptor: Path, path: Path) -> bool:
    try:
        return descriptor.readlink() == path
    except OSError:
        return False


def _wait_for(get: Callable[[], str]) -> str:
    deadline = time.monotonic() + 5.0
    while time.monotonic() < deadline:
        if text := get():
            return text
        time.sleep(0.01)
    raise AssertionError("nothing came")


@pytest.mark.parametrize("name", ["../out.mcap", "/etc/x.mcap", "sub/x.mcap", "x.csv", "a\0b.mcap"])
def test_clients_write_only_into_the_recordings_directory(tmp_path: Path, name: str) -> None:
    recorder = _recorder(tmp_path)
    with pytest.raises(BadInput, match="allowed: a file name"):
        recorder.start(name).result(5)
    recorder.close()


def test_second_start_and_unwritable_directory_are_refused(tmp_path: Path) -> None:
    recorder = _recorder(tmp_path)
    path = recorder.start().result(5)
    with pytest.raises(Unreachable, match=re.escape(f"already records to {path}; `servoctl record stop` ends it")):
        recorder.start("other.mcap").result(5)
    recorder.close()
    (tmp_path / "file").write_text("")
    blocked = _recorder(tmp_path / "file" / "below")
    with pytest.raises(Unreachable, match="below"):
        blocked.start().result(5)
    blocked.close()


def test_history_ring_keeps_the_newest_in_order() -> None:
    ring = HistoryRing(10)
    assert ring.newest(10) == b""
    ring.add(rows(4))
    assert list(split_rows(ring.newest(10))) == rows(4)
    ring.add(rows(23, 4))
    assert list(split_rows(ring.newest(10))) == rows(10, 17)
    assert len(ring) == 10
    assert list(split_rows(ring.newest(3))) == rows(3, 24)


def test_history_ring_goes_on_behind_a_serial_number() -> None:
    ring = HistoryRing(10)
    assert ring.after(0, 5) == (0, b"")
    ring.add(rows(7))
    last, raw = ring.after(0, 5)
    assert (last, list(split_rows(raw))) == (5, rows(5))
    ring.add(rows(6, 7))
    last, raw = ring.after(last, 100)
    assert (last, list(split_rows(raw))) == (13, rows(8, 5))
    assert ring.after(13, 5) == (13, b"")
    ring.add(rows(20, 13))
    assert ring.after(13, 4) == (27, b"".join(rows(4, 23)))  # 10 of those behind it had left the ring
    assert ring.after(1000, 4) == (33, b"")


def test_a_short_history_for_fault_files_leaves_room_to_read_along(tmp_path: Path) -> None:
    recorder = _recorder(tmp_path, history_s=0.005)
    recorder.add_rows(rows(1000))
    assert recorder.newest_cycle == 1000
    assert recorder.cycles_after(100, 3) == (103, b"".join(rows(3, 100)))
    fault = read_recording(recorder.write_fault_file("x").result(5))
    recorder.close()
    assert [r.cycle for r in fault.records()] == [995, 996, 997, 998, 999]


def test_what_nobody_expected_of_a_file_is_told_and_ends_neither_the_thread_nor_later_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorder = _recorder(tmp_path)
    recorder.add_rows(rows(100, 0))
    with monkeypatch.context() as patched:
        patched.setattr(McapFile, "write_rows", _no_memory)
        with pytest.raises(Unreachable, match="no memory"):
            recorder.write_fault_file("FIRST").result(5)
    assert read_recording(recorder.write_fault_file("SECOND").result(5)).column("position_rad")[99] == 0.099
    assert "no memory" in recorder.take_failure()
    recorder.close()


def _no_memory(_file: McapFile, _rows: object) -> None:
    raise MemoryError("no memory")


def test_an_event_and_a_file_that_the_queue_does_not_take_are_told(tmp_path: Path) -> None:
    recorder, disk = _recorder(tmp_path), threading.Event()
    recorder._put(lambda: print(disk.wait()))
    while recorder._put(lambda: None):
        pass
    recorder.add_event("fault", "it happened")
    assert "an event was dropped" in recorder.take_failure()
    recorder.set_attachment("gains.yaml", b"law: pd\n")
    assert "gains.yaml was dropped" in recorder.take_failure()
    disk.set()
    recorder.close()


def test_who_gave_up_waiting_does_not_end_the_recorders_thread() -> None:
    """The daemon's end cancels what requests still wait for."""
    asked, done = Future[None](), list[None]()
    asked.cancel()
    _resolve(asked, lambda: done.append(None))
    assert done == []
