"""Health, faults, arguments, requests and locks: what the supervisor is made of."""

import logging
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from unittest.mock import Mock

import pytest
from daemon_rows import record, rows

from servod.common.errors import Unreachable
from servod.common.faults import FAULTS, FaultCode
from servod.common.shipped import shipped
from servod.formats.config import BrakeConfig, BusConfig, InputsConfig, RecorderConfig, load_config
from servod.formats.recording.mcap_reader import read_recording
from servod.runtime.daemon.fault_watch import FaultWatch
from servod.runtime.daemon.health import Health, Pulse, StandingLoop
from servod.runtime.daemon.metrics import AxisMetrics
from servod.runtime.daemon.nodes import FaultRelay, nmt_name
from servod.runtime.daemon.recorder import Recorder
from servod.runtime.daemon.status import (
    Freshness,
    axis_status,
    brake_status,
    bus_status,
    fault_status,
    inputs_status,
    motion_status,
)
from servod.runtime.daemon.supervisor import Supervisor
from servod.runtime.daemon.verbs import _why_not_enabled
from servod.runtime.fieldbus.devices import Reason
from servod.runtime.loop.axis_state import AxisState
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


def _due(standing: StandingLoop, rounds: Sequence[tuple[int, bool, bool]]) -> list[int]:
    """The moments at which the drive is to be stopped; `rounds`: time in ms, whether the loop wrote, the drive told."""
    return [at for at, wrote, told in rounds if standing.look(wrote, told, at * 1_000_000)]


def test_a_standing_loop_whose_drive_misses_it_is_passed_at_once_and_once() -> None:
    standing = StandingLoop(0.02)
    assert _due(standing, [(0, True, True), (20, True, False), (40, False, False), (60, False, True)]) == [60]
    assert _due(standing, [(80, False, True), (2000, False, False)]) == [], "once for each standstill"
    assert _due(standing, [(2020, True, False), (2040, False, True)]) == [2040]
    assert _due(standing, [(2060, True, True), (2080, False, False)]) == [2080], "told in the round of the last record"


def test_a_silent_loop_is_passed_when_its_drive_must_have_reacted_and_not_for_a_stall() -> None:
    silent = [(at, at == 0, False) for at in range(0, 400, 20)]
    assert _due(StandingLoop(0.02), silent) == [140], "0.12 s passed, whatever the drive tells"
    assert _due(StandingLoop(0.1), silent) == [220]
    stalls = [(0, True, False), (50, False, False), (100, False, False), (120, True, False)]
    assert _due(StandingLoop(0.02), stalls) == []
    assert _due(StandingLoop(0.02), [(0, True, False), (5000, False, False)]) == [], "the watcher itself stood still"


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
    assert (status["goal_reached"], status["reasons"]) == (False, ["the wiring is being tested"])


def test_an_axis_whose_brake_opens_has_not_reached_its_goal() -> None:
    status = axis_status(record(axis_state=AxisState.RELEASING, goal=2, goal_reached=1))
    assert (status["goal_reached"], status["reasons"]) == (False, ["the brake opens"])


def test_inputs_and_brake_are_shown_where_there_are_any() -> None:
    at_rest, stopped = record(axis_state=AxisState.ENABLED), record(faults=FAULTS[FaultCode.ESTOP_ACTIVE].bit)
    inputs = InputsConfig(estop_bit=16, sto_error=0x5441)
    assert [row["active"] for row in inputs_status(inputs, at_rest)] == [False, False]
    assert [row for row in inputs_status(inputs, stopped) if row["active"]] == [{"name": "estop", "active": True}]
    assert inputs_status(InputsConfig(), stopped) == []
    assert brake_status(BrakeConfig(), at_rest) == {"by": "none", "state": "none"}
    shown = [brake_status(BrakeConfig(by="drive"), record(axis_state=state))["state"] for state in AxisState]
    assert shown.count("open") == 3, "proving, enabled, braking"
    assert {"closed", "opening", "closing", "closing at rest"} < set(shown)


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


# --- the end ----------------------------------------------------------------------------------------------------------
def _ending(exit_code: int) -> tuple[Supervisor, Mock]:
    """A supervisor made of mocks, whose loop ends with that code."""
    supervisor, told = Supervisor.__new__(Supervisor), Mock()
    supervisor.__dict__.update(
        {f"_{name}": getattr(told, name) for name in ("nodes", "loop", "notifier", "faults", "take_records")}
    )
    supervisor._config = load_config(shipped("gains/config/virtual.yaml"))
    told.loop.stop.return_value, told.loop.last_words.return_value = exit_code, ""
    return supervisor, told


def _order(told: Mock) -> list[str]:
    names = (name for name, _, _ in told.mock_calls)
    return [name for name in names if name in ("notifier.stopping", "loop.stop") or name.startswith("nodes.")]


def test_systemd_is_told_and_a_hung_loop_killed_before_a_silent_drive_holds_up_anything() -> None:
    supervisor, told = _ending(-9)
    assert supervisor._lose_loop() == Unreachable.exit_code
    assert _order(told) == ["notifier.stopping", "loop.stop", "nodes.stop_axis"]


@pytest.mark.parametrize(
    ("exit_code", "last"), [(1, ["notifier.stopping", "nodes.stop_axis"]), (0, ["nodes.stand_down"])]
)
def test_a_loop_that_dies_in_an_orderly_stop_leaves_the_drive_to_brake(exit_code: int, last: list[str]) -> None:
    supervisor, told = _ending(exit_code)
    supervisor._stop()
    assert _order(told) == ["notifier.stopping", "loop.stop", *last]
