"""Health, faults, arguments, flows and locks: what the supervisor is made of."""

import logging
import subprocess
import sys
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import pytest
from daemon_rows import record, rows

from servod.axis import AxisState
from servod.commands import ReferenceKind, Refusal
from servod.config import AxisConfig, RecorderConfig
from servod.control import Verb
from servod.daemon.arguments import check_arguments
from servod.daemon.control_server import Reply
from servod.daemon.fault_watch import FaultWatch
from servod.daemon.flows import Flow, Flows, FutureWait, Orders, StateWait
from servod.daemon.health import Health
from servod.daemon.lock import InstanceLock
from servod.daemon.status import axis_status, fault_status, motion_status
from servod.errors import BadInput, FaultCode, Unreachable
from servod.hal import Reason
from servod.metrics import AxisMetrics
from servod.recorder import Recorder
from servod.recorder_read import read_recording

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


def test_health_without_cycles() -> None:
    assert Health(1000, 0.5).line() == "no cycle yet"
    assert Health(1000, 0.5).timing(0)["lag"]["max_us"] == 0.0


# --- status -----------------------------------------------------------------------------------------------------------
def test_status_says_why_the_goal_is_not_reached() -> None:
    status = axis_status(record(axis_state=AxisState.ENABLING, goal=2, reasons=Reason.NO_VOLTAGE | Reason.HANDSHAKE))
    assert (status["state"], status["goal"], status["goal_reached"]) == ("ENABLING", "ENABLED", False)
    assert [r.split()[0:3] for r in status["reasons"]] == [["the", "drive", "has"], ["waiting", "for", "the"]]


def test_values_that_are_not_finite_are_none() -> None:
    motion = motion_status(record(position_rad=float("nan"), torque_nm=float("inf"), reference_rad=1.0))
    assert (motion["position_rad"], motion["following_error_rad"], motion["torque_nm"]) == (None, None, None)
    assert motion["reference_rad"] == 1.0


def test_latched_and_present_faults_are_told_apart() -> None:
    faults = fault_status(record(faults=STALE, faults_latched=FOLLOWING | STALE))
    assert [(f["code"], f["present"]) for f in faults] == [("FOLLOWING_ERROR", False), ("FEEDBACK_STALE", True)]


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


# --- arguments --------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("args", "reference"),
    [
        ({"kind": "paper", "duration_s": 10}, [ReferenceKind.PAPER, 10.0]),
        ({"kind": "step", "amplitude_rad": 0.01, "duration_s": 2}, [ReferenceKind.STEP, 0.01, 2.0]),
        (
            {"kind": "sine", "amplitude_rad": 0.1, "frequency_hz": 0.5, "duration_s": 4},
            [ReferenceKind.SINE, 0.1, 0.5, 4.0],
        ),
        ({"kind": "csv", "positions_rad": [0.0, 0.2, -0.1]}, [ReferenceKind.TABLE, 3, -0.1, 0.2]),
    ],
)
def test_motions_become_the_loops_arguments(args: dict[str, Any], reference: list[float]) -> None:
    assert check_arguments(Verb.TRACK, args).reference() == reference


@pytest.mark.parametrize(
    ("verb", "args", "says"),
    [
        (Verb.TRACK, {}, "track: kind"),
        (Verb.TRACK, {"kind": "fly"}, "'fly'"),
        (Verb.TRACK, {"kind": "sine", "amplitude_rad": 0.1}, "frequency_hz, duration_s"),
        (Verb.TRACK, {"kind": "paper", "duration_s": -1}, "duration_s"),
        (Verb.TRACK, {"kind": "paper", "duration_s": float("nan")}, "duration_s"),
        (Verb.TRACK, {"kind": "csv", "positions_rad": [0.0]}, "positions_rad"),
        (Verb.TRACK, {"kind": "csv", "positions_rad": [0.0, float("inf")]}, "positions_rad.1"),
        (Verb.TRACK, {"kind": "csv", "positions_rad": [0.0] * 300_001}, "300000"),
        (Verb.TRACK, {"kind": "paper", "duration_s": 1, "speed": 2}, "speed"),
        (Verb.ENABLE, {"reset": True}, "did you mean reset_fault"),
        (Verb.ENABLE, {"reset_fault": "perhaps"}, "reset_fault"),
        (Verb.GAINS_LOAD, {"name": "x"}, "text"),
        (Verb.GAINS_ACTIVATE, {"name": ""}, "name"),
        (Verb.STATUS, {"x": 1}, "unknown key"),
    ],
)
def test_bad_arguments_are_one_line(verb: Verb, args: dict[str, Any], says: str) -> None:
    with pytest.raises(BadInput) as caught:
        check_arguments(verb, args)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 400


# --- flows ------------------------------------------------------------------------------------------------------------
class _Answers:
    def __init__(self) -> None:
        self.sent: list[dict[str, Any]] = []

    def reply(self) -> Reply:
        return Reply(self.sent.append, 1)


def test_flow_goes_on_when_its_order_comes_back() -> None:
    orders, flows, answers = Orders(), Flows(), _Answers()

    def flow() -> Flow:
        done = yield orders.expect(7, 0)
        return {"cycle": done.cycle}

    flows.start(flow(), answers.reply())
    orders.see([record(5, command_seq=6)], 1)
    flows.poll(1)
    assert answers.sent == []
    orders.see([record(6, command_seq=7), record(7, command_seq=8)], 2)
    flows.poll(2)
    assert answers.sent == [{"id": 1, "ok": True, "result": {"cycle": 6}}]


def test_refusal_and_silence_end_a_flow_with_the_reason() -> None:
    orders, flows, answers = Orders(), Flows(), _Answers()

    def flow(seq: int) -> Flow:
        yield orders.expect(seq, 0)
        return {}

    flows.start(flow(1), answers.reply())
    flows.start(flow(2), answers.reply())
    orders.see([record(1, command_seq=1, command_result=Refusal.NOT_ENABLED)], 1)
    flows.poll(1)
    flows.poll(Orders.TIMEOUT_NS)
    messages = [a["error"]["message"] for a in answers.sent]
    assert ["not enabled" in messages[0], "did not answer" in messages[1]] == [True, True]


def test_flow_waits_for_threads_and_states_and_may_catch_errors() -> None:
    flows, answers, future = Flows(), _Answers(), Future[int]()
    now = record(axis_state=AxisState.ENABLING)

    def flow() -> Flow:
        try:
            yield FutureWait(future)
        except Unreachable:
            seen = yield StateWait(lambda: now, lambda r: r.axis_state == AxisState.ENABLED, 100)
        return {"state": seen.axis_state}

    flows.start(flow(), answers.reply())
    flows.poll(1)
    future.set_exception(Unreachable("no"))
    flows.poll(2)
    flows.poll(3)
    assert answers.sent == []
    now = record(axis_state=AxisState.ENABLED)
    flows.poll(4)
    assert answers.sent[0]["result"] == {"state": AxisState.ENABLED}


def test_full_disk_ends_the_request_only() -> None:
    flows, answers, future = Flows(), _Answers(), Future[int]()

    def flow() -> Flow:
        yield FutureWait(future)
        return {}

    flows.start(flow(), answers.reply())
    future.set_exception(OSError(28, "No space left on device", "active.json"))
    flows.poll(1)
    assert answers.sent[0]["error"] == {"exit_code": 3, "message": "active.json: No space left on device"}


# --- instance lock ----------------------------------------------------------------------------------------------------
def _config(socket: Path, channel: Path) -> AxisConfig:
    limits = {
        "torque_nm": 1,
        "torque_rate_nm_per_s": 1,
        "speed_rad_s": 1,
        "position_min_rad": -1,
        "position_max_rad": 1,
        "following_error_rad": 1,
        "encoder_mismatch_rad": 1,
    }
    return AxisConfig.model_validate(
        {
            "limits": limits,
            "gains": {"initial": "x.yaml"},
            "control": {"socket": str(socket)},
            "bus": {"channel": str(channel)},
        }
    )


def test_second_daemon_on_socket_or_bus_is_refused(tmp_path: Path) -> None:
    first = InstanceLock(_config(tmp_path / "a.sock", tmp_path / "bus1"))
    for socket, channel in (("a.sock", "bus2"), ("b.sock", "bus1")):
        with pytest.raises(Unreachable, match=r"another servod \(process [0-9]+\)"):
            InstanceLock(_config(tmp_path / socket, tmp_path / channel))
    InstanceLock(_config(tmp_path / "b.sock", tmp_path / "bus2")).release()
    first.release()
    InstanceLock(_config(tmp_path / "a.sock", tmp_path / "bus1")).release()
    assert not list(tmp_path.iterdir())


# --- the program ------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ([], "--config"),
        (["--config", "missing.yaml"], "missing.yaml: found No such file"),
        (["--config", "x", "--fast"], "--fast"),
    ],
)
def test_bad_usage_is_exit_code_2_and_one_line(arguments: list[str], says: str, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "servod.daemon.main", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert says in done.stderr


@pytest.mark.parametrize("name", ["virtual", "can0"])
def test_shipped_configurations_are_good(name: str) -> None:
    path = Path(__file__).parents[2] / "gains" / "config" / f"{name}.yaml"
    command = [sys.executable, "-m", "servod.daemon.main", "--config", str(path), "--check"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


def test_daemon_imports_nothing_of_the_laboratory() -> None:
    heavy = "('numpy', 'scipy', 'numba', 'matplotlib', 'plotly', 'pyarrow', 'cvxpy')"
    code = f"import sys, servod.daemon.main; sys.exit(str([m for m in {heavy} if m in sys.modules] or ''))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stderr.strip() == ""
