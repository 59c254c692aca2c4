"""Health, faults, arguments, flows and locks: what the supervisor is made of."""

import logging
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from pathlib import Path
from typing import Any, cast

import pytest
from daemon_rows import record, rows

from servod.axis import AxisState
from servod.commands import Command, Op, ReferenceKind, Refusal
from servod.config import AxisConfig, BusConfig, RecorderConfig
from servod.control import SampleKey, Verb
from servod.daemon.arguments import check_arguments
from servod.daemon.connection import Reply
from servod.daemon.fault_watch import FaultWatch
from servod.daemon.flows import Flow, Flows, FutureWait, Orders, StateWait
from servod.daemon.gain_bank import GainBank
from servod.daemon.health import Health, Pulse
from servod.daemon.lock import BusLock, InstanceLock
from servod.daemon.nodes import nmt_name
from servod.daemon.status import axis_status, bus_status, fault_status, motion_status
from servod.daemon.trajectory import Table, check_motion
from servod.daemon.verbs import Verbs
from servod.errors import BadInput, FaultCode, Unreachable
from servod.hal import DriveState, Reason
from servod.loop.channel import Channel
from servod.loop.handle import LoopHandle
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


def test_values_that_are_not_finite_are_none() -> None:
    motion = motion_status(record(position_rad=float("nan"), torque_nm=float("inf"), reference_rad=1.0))
    assert (motion["position_rad"], motion["following_error_rad"], motion["torque_nm"]) == (None, None, None)
    assert motion["reference_rad"] == 1.0


def test_latched_and_present_faults_are_told_apart() -> None:
    faults = fault_status(record(faults=STALE, faults_latched=FOLLOWING | STALE))
    assert [(f["code"], f["present"]) for f in faults] == [("FOLLOWING_ERROR", False), ("FEEDBACK_STALE", True)]


def test_bus_counters_and_any_nmt_state_are_shown() -> None:
    bus = bus_status(BusConfig(), 0.4, record(late_frames=3, ignored_frames=4))
    assert (bus["late_frames"], bus["ignored_frames"]) == (3, 4)
    assert [nmt_name(n) for n in (None, 5, 2)] == ["not heard yet", "OPERATIONAL", "unknown state 2"]


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
    track = check_arguments(Verb.TRACK, args)
    assert track.reference(track.table(Table())) == reference


@pytest.mark.parametrize(
    ("verb", "args", "says"),
    [
        (Verb.TRACK, {}, "track: kind"),
        (Verb.TRACK, {"kind": "fly"}, "'fly'"),
        (Verb.TRACK, {"kind": "sine", "amplitude_rad": 0.1}, "frequency_hz, duration_s"),
        (Verb.TRACK, {"kind": "paper", "duration_s": -1}, "duration_s"),
        (Verb.TRACK, {"kind": "paper", "duration_s": float("nan")}, "duration_s"),
        (Verb.TRACK, {"kind": "csv", "positions_rad": []}, "positions_rad"),
        (Verb.TRACK, {"kind": "excite", "uploaded": True}, "window_rad"),
        (Verb.TRACK, {"kind": "csv", "positions_rad": [0.0, float("inf")]}, "positions_rad.1"),
        (Verb.TRACK, {"kind": "csv", "positions_rad": [0.0] * 2001}, "2000"),
        (Verb.TRAJECTORY, {"key": "positions", "start": 0, "samples": [1.0]}, "torques_nm"),
        (Verb.TRAJECTORY, {"key": "positions_rad", "start": -1, "samples": [1.0]}, "start"),
        (Verb.TRAJECTORY, {"key": "positions_rad", "start": 0, "samples": [float("nan")]}, "samples.0"),
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


# --- trajectories -----------------------------------------------------------------------------------------------------
def test_pieces_become_one_column_with_its_extent_and_steps() -> None:
    table = Table()
    table.add(SampleKey.POSITIONS, 0, [9.0])
    for start, piece in ((0, [0.0, 0.1]), (2, [0.4, 0.3])):
        table.add(SampleKey.POSITIONS, start, piece)
    positions = table.positions
    assert list(table.area()) == [0.0, 0.1, 0.4, 0.3]
    assert (positions.lowest, positions.highest, positions.largest_step) == (0.0, 0.4, pytest.approx(0.3))
    with pytest.raises(BadInput, match="or 4 to go on"):
        table.add(SampleKey.POSITIONS, 5, [0.0])
    with pytest.raises(BadInput, match="found 0 samples; allowed: 4"):
        table.require(torques=True)
    with pytest.raises(BadInput, match="at most 300000"):
        table.add(SampleKey.TORQUES, 0, [0.0] * 300_001)


@pytest.mark.parametrize(
    ("args", "says"),
    [
        ({"kind": "step", "amplitude_rad": 0.6, "duration_s": 1}, "from 0.5 to 1.1 rad"),
        ({"kind": "sine", "amplitude_rad": 0.4, "frequency_hz": 2, "duration_s": 1}, "5.02655 rad/s"),
        ({"kind": "csv", "positions_rad": [0.0, 0.0051]}, "5.1 rad/s; limits.speed_rad_s allows 5"),
        ({"kind": "csv", "positions_rad": [0.0, -2.0]}, "-1.5 to 0.5 rad"),
        ({"kind": "paper", "duration_s": 40}, "out of range"),
    ],
)
def test_motion_is_checked_with_figures_before_the_loop_is_asked(args: dict[str, Any], says: str) -> None:
    track = check_arguments(Verb.TRACK, args)
    table = track.table(Table())
    config = _config(Path("s"), Path("c"))
    limits = config.limits.model_copy(update={"speed_rad_s": 5.0})
    with pytest.raises(Unreachable) as caught:
        check_motion(
            track.reference(table), table, config.model_copy(update={"limits": limits}), record(reference_rad=0.5)
        )
    assert says in str(caught.value)


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


def test_mistake_in_a_flow_ends_the_request_only() -> None:
    flows, answers = Flows(), _Answers()

    def flow() -> Flow:
        yield from ()
        raise KeyError("nobody foresaw this")

    flows.start(flow(), answers.reply())
    assert "nobody foresaw" in answers.sent[0]["error"]["message"]


# --- verbs ------------------------------------------------------------------------------------------------------------
class _Loop:
    """What the verbs need of the loop's handle, with a loop that answers when it is told to."""

    def __init__(self) -> None:
        self.latest = record(1, axis_state=AxisState.ENABLED)
        self.seq = 0
        self.area: list[float] = []

    def send(self, _op: Op, _arguments: Sequence[float] = ()) -> int:
        self.seq += 1
        return self.seq

    def write_trajectory(self, positions_rad: Sequence[float]) -> None:
        self.area = list(positions_rad)


class _Events:
    def add_event(self, *_: Any, **__: Any) -> None:
        """Nothing is recorded here."""


@pytest.fixture
def verbs(tmp_path: Path) -> Iterator[tuple[Verbs, _Loop]]:
    loop, config = _Loop(), _config(tmp_path / "s", tmp_path / "c")
    config = config.model_copy(update={"limits": config.limits.model_copy(update={"speed_rad_s": 1e3})})
    verbs = Verbs(config, cast(LoopHandle, loop), cast(GainBank, None), cast(Recorder, _Events()), dict)
    yield verbs, loop
    verbs.close()


def _csv(verbs: Verbs, positions: list[float], **more: Any) -> list[dict[str, Any]]:
    answers = _Answers()
    verbs.handle(Verb.TRACK, {"kind": "csv", "positions_rad": positions, **more}, answers.reply())
    return answers.sent


def test_trajectory_is_in_use_from_its_command_to_the_motions_end(verbs: tuple[Verbs, _Loop]) -> None:
    front, loop = verbs
    assert _csv(front, [0.0, 0.1, 0.2]) == []
    first = loop.area
    for seen in ({}, {"command_seq": 1, "reference_active": 1}):
        loop.latest = record(2, axis_state=AxisState.ENABLED, **seen)
        assert front.motion_running()
        (answer,) = _csv(front, [0.3, 0.3, 0.3])
        assert "a motion is running" in answer["error"]["message"]
        assert (loop.area, loop.seq) == (first, 1)
    loop.latest = record(3, axis_state=AxisState.ENABLED, command_seq=1)
    assert _csv(front, [0.3, 0.3, 0.3]) == []
    assert loop.area == [0.3, 0.3, 0.3]


def test_check_alone_moves_nothing_and_tells_what_is_wrong(verbs: tuple[Verbs, _Loop]) -> None:
    front, loop = verbs
    loop.latest = record(1, axis_state=AxisState.DISABLED)
    (good,) = _csv(front, [0.0, 0.1], start_immediately=False)
    assert good["result"]["duration_s"] == pytest.approx(0.001)
    (bad,) = _csv(front, [0.0, 2.0], start_immediately=False)
    assert "position_max_rad" in bad["error"]["message"]
    assert (loop.area, loop.seq) == ([], 0)


def test_samples_of_a_client_that_left_are_void(verbs: tuple[Verbs, _Loop]) -> None:
    front, _ = verbs
    args = {"key": "positions_rad", "start": 0, "samples": [0.0, 0.1]}
    front.handle(Verb.TRAJECTORY, args, _Answers().reply())
    front.lease_ended()
    answers = _Answers()
    front.handle(Verb.TRACK, {"kind": "csv", "uploaded": True}, answers.reply())
    assert "found 0 samples" in answers.sent[0]["error"]["message"]


@pytest.mark.parametrize("verb", [Verb.STOP, Verb.DISABLE])
@pytest.mark.parametrize(
    ("now", "says"),
    [
        ({"axis_state": AxisState.QUICK_STOPPING, "drive_state": DriveState.QUICK_STOP_ACTIVE}, "QUICK_STOPPING"),
        ({"axis_state": AxisState.DISABLED, "drive_state": DriveState.OPERATION_ENABLED}, "OPERATION_ENABLED"),
        (
            {"axis_state": AxisState.FAULT, "drive_state": DriveState.SWITCH_ON_DISABLED, "amplifier_age": 99},
            "99 cycles ago",
        ),
    ],
)
def test_stop_that_stopped_nothing_is_no_success(
    verbs: tuple[Verbs, _Loop], verb: Verb, now: dict[str, int], says: str
) -> None:
    front, loop = verbs
    answers = _Answers()
    front.handle(verb, {}, answers.reply())
    loop.latest = record(2, command_seq=1, **now)
    front.tick([loop.latest], time.monotonic_ns())
    front.tick([], time.monotonic_ns())
    assert answers.sent == []
    front.tick([], time.monotonic_ns() + 60_000_000_000)
    assert answers.sent[0]["error"]["exit_code"] == 3
    assert says in answers.sent[0]["error"]["message"]


def test_queue_that_a_client_floods_leaves_room_for_stops_and_node_events() -> None:
    channel = Channel()
    taken = {op: [channel.send(Command(n, op, ())) for n in range(16)].count(True) for op in _FLOOD}
    assert taken == {Op.HALT: 8, Op.QUICK_STOP: 4, Op.NODE_EVENT: 4}
    channel.close()


_FLOOD = (Op.HALT, Op.QUICK_STOP, Op.NODE_EVENT)


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
    with BusLock(BusConfig(channel=str(tmp_path / "bus1"))), pytest.raises(Unreachable, match="another servod"):
        InstanceLock(_config(tmp_path / "a.sock", tmp_path / "bus1"))
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
