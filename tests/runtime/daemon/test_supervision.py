"""Health, faults, arguments, requests and locks: what the supervisor is made of."""

import logging
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest
from daemon_rows import axis_config, record, rows

from servod.common.errors import Unreachable
from servod.common.faults import FaultCode
from servod.formats.config import BusConfig, RecorderConfig
from servod.formats.recording.mcap_reader import read_recording
from servod.runtime.daemon.fault_watch import FaultWatch
from servod.runtime.daemon.health import Health, Pulse
from servod.runtime.daemon.lock import BusLock, InstanceLock
from servod.runtime.daemon.metrics import AxisMetrics
from servod.runtime.daemon.nodes import FaultRelay, nmt_name
from servod.runtime.daemon.recorder import Recorder
from servod.runtime.daemon.status import Freshness, axis_status, bus_status, fault_status, motion_status
from servod.runtime.daemon.verbs import _why_not_enabled
from servod.runtime.fieldbus.devices import Reason
from servod.runtime.loop.axis import AxisState
from servod.runtime.loop.commands import Op

FOLLOWING = 1 << FaultCode.FOLLOWING_ERROR
STALE = 1 << FaultCode.FEEDBACK_STALE


# --- health -----------------------------------------------------------------------------------------------------------
def test_percentiles_are_of_the_last_ten_seconds_only() -> None:
    health = Health(1000, 0.5)
    health.add([record(n, lag_ns=9_000_000) for n in range(5000)])
    health.add([record(n, lag_ns=n * 1000) for n in range(10_000)])
    timing = health.timing(3)
    assert timing["lag"] == {"p50_us": 4999.0, "p99_us": 9899.0, "max_us": 9999.0}
    assert (timing["window_s"], timing["cycle"], timing["records_lost"]) == (10.0, 9999, 3)
    assert "bus load 50%" in health.line()


def _look(pulse: Pulse, times_ms: Sequence[int]) -> bool:
    for time_ms in times_ms:
        pulse.look(False, time_ms * 1_000_000)
    return pulse.stopped


def test_loop_hangs_after_a_second_of_silence_however_many_rounds_that_is() -> None:
    pulse = Pulse(1000)
    assert not _look(pulse, [0] + [1] * 5000 + list(range(10, 1000, 10)))
    assert _look(pulse, [1000, 1010])
    pulse.look(True, 1_020_000_000)
    assert not pulse.stopped


def test_slow_loop_has_many_periods_and_a_stalled_watcher_blames_nobody() -> None:
    assert not _look(Pulse(40_000), range(0, 2000, 20))
    assert _look(Pulse(40_000), range(0, 2100, 20))
    stalled = Pulse(1000)
    assert not _look(stalled, [*range(0, 900, 20), 60_000, *range(60_020, 60_900, 20)])
    assert _look(stalled, [*range(60_900, 61_100, 20)])


def test_health_without_cycles() -> None:
    assert Health(1000, 0.5).line() == "no cycle yet"
    assert Health(1000, 0.5).timing(0)["lag"]["max_us"] == 0.0


# --- status -----------------------------------------------------------------------------------------------------------
def test_status_says_why_the_goal_is_not_reached() -> None:
    status = axis_status(record(axis_state=AxisState.ENABLING, goal=2, reasons=Reason.NO_VOLTAGE | Reason.HANDSHAKE))
    assert (status["state"], status["goal"], status["goal_reached"]) == ("ENABLING", "ENABLED", False)
    assert [r.split()[0:3] for r in status["reasons"]] == [["the", "drive", "has"], ["waiting", "for", "the"]]


def test_an_axis_whose_wiring_is_being_proven_has_not_reached_its_goal() -> None:
    status = axis_status(record(axis_state=AxisState.PROVING, goal=2, goal_reached=1))
    assert (status["goal_reached"], status["reasons"]) == (False, ["wiring is being proven"])


def test_an_axis_that_somebody_stopped_is_told_so_and_a_fault_goes_first() -> None:
    assert "somebody stopped it" in _why_not_enabled(record(axis_state=AxisState.DISABLED))
    told = _why_not_enabled(record(axis_state=AxisState.FAULT, faults_latched=STALE))
    assert told.startswith("FEEDBACK_STALE: ")


def test_values_that_are_not_finite_are_none() -> None:
    motion = motion_status(
        record(position_rad=float("nan"), torque_nm=float("inf"), reference_rad=1.0), Freshness(0.001, 5, 0.0)
    )
    assert (motion["position_rad"], motion["following_error_rad"], motion["torque_nm"]) == (None, None, None)
    assert motion["reference_rad"] == 1.0


def test_latched_and_present_faults_are_told_apart() -> None:
    faults = fault_status(record(faults=STALE, faults_latched=FOLLOWING | STALE))
    assert [(f["code"], f["present"]) for f in faults] == [("FOLLOWING_ERROR", False), ("FEEDBACK_STALE", True)]


def test_bus_counters_and_any_nmt_state_are_shown() -> None:
    bus = bus_status(BusConfig(), 0.4, record(late_frames=3, ignored_frames=4))
    assert (bus["late_frames"], bus["ignored_frames"]) == (3, 4)
    assert [nmt_name(n) for n in (None, 5, 2)] == ["not heard yet", "OPERATIONAL", "unknown state 2"]


def test_node_faults_wait_for_a_place_in_the_queue_and_come_once_each() -> None:
    sent: list[float] = []
    room = [0]

    def send(op: Op, arguments: Sequence[float]) -> int:
        if op is not Op.NODE_EVENT or len(sent) >= room[-1]:
            raise Unreachable("full")
        sent.extend(arguments)
        return len(sent)

    relay = FaultRelay(send)
    for fault in (FaultCode.DRIVE_RESET, FaultCode.NODE_HEARTBEAT_LOST, FaultCode.DRIVE_RESET):
        relay.add(fault)
    relay.flush()
    assert sent == []
    for slots in (1, 1, 9, 9):
        room.append(slots)
        relay.flush()
    assert sent == [FaultCode.DRIVE_RESET, FaultCode.NODE_HEARTBEAT_LOST]


# --- faults -----------------------------------------------------------------------------------------------------------
@pytest.fixture
def recorder(tmp_path: Path) -> Recorder:
    return Recorder(RecorderConfig(directory=tmp_path, history_s=1.0), "axis", 1000)


def test_each_fault_is_told_once_with_remedy_and_health(recorder: Recorder, caplog: pytest.LogCaptureFixture) -> None:
    health = Health(1000, 0.4)
    watch = FaultWatch(recorder, health, AxisMetrics("axis", 0.4))
    with caplog.at_level(logging.INFO, "servod"):
        health.add([record(1)])
        watch.see([record(n, faults=FOLLOWING, faults_latched=FOLLOWING) for n in range(100)], 0)
        watch.see([record(n, faults_latched=FOLLOWING) for n in range(100, 200)], 0)
    (line,) = [r.getMessage() for r in caplog.records]
    assert "FOLLOWING_ERROR (RAMP_DOWN)" in line
    assert "blocked joint" in line
    assert "lag p50 50" in line
    caplog.clear()
    watch.see([record(201, axis_state=AxisState.ENABLING), record(202, faults_latched=FOLLOWING)], 0)
    assert len(caplog.records) == 1
    recorder.close()


def test_fault_file_follows_the_fault_by_half_a_second(recorder: Recorder, tmp_path: Path) -> None:
    watch = FaultWatch(recorder, Health(1000, 0.4), AxisMetrics("axis", 0.4))
    recorder.add_rows(rows(2000))
    watch.see([record(2000, faults=FOLLOWING)], 1_000_000_000)
    watch.tick(1_400_000_000)
    recorder.add_rows(rows(500, 2000))
    watch.tick(1_600_000_000)
    recorder.close()
    (path,) = tmp_path.glob("axis-fault-*-FOLLOWING_ERROR.mcap")
    recording = read_recording(path)
    assert list(recording.column("cycle")) == list(range(1500, 2500))
    assert [e["code"] for e in recording.events] == ["FOLLOWING_ERROR"]


def test_clipping_writes_no_file(recorder: Recorder, tmp_path: Path) -> None:
    watch = FaultWatch(recorder, Health(1000, 0.4), AxisMetrics("axis", 0.4))
    watch.see([record(1, faults=1 << FaultCode.TORQUE_CLIPPED)], 0)
    watch.tick(10**10)
    watch.finish()
    recorder.close()
    assert not list(tmp_path.iterdir())


# --- instance lock ----------------------------------------------------------------------------------------------------
def test_second_daemon_on_socket_or_bus_is_refused(tmp_path: Path) -> None:
    first = InstanceLock(axis_config(tmp_path / "a.sock", tmp_path / "bus1"))
    for socket, channel in (("a.sock", "bus2"), ("b.sock", "bus1")):
        with pytest.raises(Unreachable, match=r"another servod \(process [0-9]+\)"):
            InstanceLock(axis_config(tmp_path / socket, tmp_path / channel))
    InstanceLock(axis_config(tmp_path / "b.sock", tmp_path / "bus2")).release()
    first.release()
    with BusLock(BusConfig(channel=str(tmp_path / "bus1"))), pytest.raises(Unreachable, match="another servod"):
        InstanceLock(axis_config(tmp_path / "a.sock", tmp_path / "bus1"))
    InstanceLock(axis_config(tmp_path / "a.sock", tmp_path / "bus1")).release()
    assert not list(tmp_path.iterdir())


# --- the program ------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ([], "--config"),
        (["--config", "missing.yaml"], "missing.yaml: there is no such file"),
        (["--config", "x", "--fast"], "--fast"),
    ],
)
def test_bad_usage_is_exit_code_2_and_one_line(arguments: list[str], says: str, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "servod.runtime.daemon.main", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert says in done.stderr


@pytest.mark.parametrize("name", ["virtual", "can0"])
def test_shipped_configurations_are_good(name: str) -> None:
    path = Path(__file__).parents[3] / "gains" / "config" / f"{name}.yaml"
    command = [sys.executable, "-m", "servod.runtime.daemon.main", "--config", str(path), "--check"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "ERROR" not in done.stderr  # a note on a group that this machine does not have is all that may come


def test_daemon_imports_nothing_of_the_laboratory() -> None:
    heavy = "('numpy', 'scipy', 'numba', 'matplotlib', 'pyarrow', 'cvxpy')"
    code = f"import sys, servod.runtime.daemon.main; sys.exit(str([m for m in {heavy} if m in sys.modules] or ''))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stderr.strip() == ""
