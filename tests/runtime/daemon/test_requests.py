"""Requests: their arguments, how they wait, and what the verbs make of them."""

import asyncio
import json
import math
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from pathlib import Path
from typing import Any, cast

import pytest
from daemon_rows import axis_config, record, row, rows

from servod.client.control import ControlClient, CycleStream
from servod.common.errors import BadInput, Unreachable
from servod.formats.config import RecorderConfig
from servod.formats.protocol import PIECE_CYCLES, Verb, encode_line
from servod.formats.recording.record import CycleRecord
from servod.runtime.daemon.arguments import check_arguments
from servod.runtime.daemon.connection import Reply
from servod.runtime.daemon.gain_bank import GainBank
from servod.runtime.daemon.guard_test import GuardTestStatus
from servod.runtime.daemon.recorder import Recorder
from servod.runtime.daemon.requests import Requests, Waits, finish, work_of
from servod.runtime.daemon.trajectory import MotionTable
from servod.runtime.daemon.verbs import Verbs
from servod.runtime.fieldbus.bus import Bus
from servod.runtime.fieldbus.devices import DriveState
from servod.runtime.loop.axis_state import AxisState
from servod.runtime.loop.channel import Channel
from servod.runtime.loop.commands import Op, ReferenceKind, Refusal
from servod.runtime.loop.handle import LoopHandle
from tests.on_event_loop import events_pass, on_event_loop


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
    assert track.reference(track.table(MotionTable())) == reference


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
        (Verb.CYCLES, {"after": -1}, "after"),
    ],
)
def test_bad_arguments_are_one_line(verb: Verb, args: dict[str, Any], says: str) -> None:
    with pytest.raises(BadInput) as caught:
        check_arguments(verb, args)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 400


# --- requests ---------------------------------------------------------------------------------------------------------
class _Answers:
    def __init__(self) -> None:
        self.sent: list[dict[str, Any]] = []

    def reply(self) -> Reply:
        return Reply(self.sent.append, 1)


@on_event_loop
async def test_request_goes_on_when_its_order_comes_back() -> None:
    waits, requests, answers = Waits(), Requests(), _Answers()

    async def request() -> dict[str, Any]:
        done = await waits.order(7, 0)
        return {"cycle": done.cycle}

    requests.start(request(), answers.reply())
    waits.see([record(5, command_seq=6)], 1)
    await events_pass()
    assert answers.sent == []
    waits.see([record(6, command_seq=7), record(7, command_seq=8)], 2)
    await events_pass()
    assert answers.sent == [{"id": 1, "ok": True, "result": {"cycle": 6}}]


@on_event_loop
async def test_request_has_begun_before_anything_else_happens() -> None:
    """A client that leaves in the same moment is seen to leave afterwards."""
    waits, requests, begun = Waits(), Requests(), []

    async def request() -> dict[str, Any]:
        begun.append(True)
        await waits.order(1, 0)
        return {}

    requests.start(request(), _Answers().reply())
    assert begun == [True]


@on_event_loop
async def test_refusal_and_silence_end_a_request_with_the_reason() -> None:
    waits, requests, answers = Waits(), Requests(), _Answers()

    async def request(seq: int) -> dict[str, Any]:
        await waits.order(seq, 0)
        return {}

    requests.start(request(1), answers.reply())
    requests.start(request(2), answers.reply())
    waits.see([record(1, command_seq=1, command_result=Refusal.NOT_ENABLED)], 1)
    await events_pass()
    waits.see([], Waits.TIMEOUT_NS)
    await events_pass()
    messages = [a["error"]["message"] for a in answers.sent]
    assert ["not enabled" in messages[0], "did not answer" in messages[1]] == [True, True]


@on_event_loop
async def test_request_waits_for_threads_and_states_and_may_catch_errors() -> None:
    waits, requests, answers, future = Waits(), Requests(), _Answers(), Future[int]()
    now = record(axis_state=AxisState.ENABLING)

    async def request() -> dict[str, Any]:
        try:
            await work_of(future)
        except Unreachable:
            await waits.until(lambda now_ns: now_ns >= 100 or now.axis_state == AxisState.ENABLED)
        return {"state": now.axis_state}

    requests.start(request(), answers.reply())
    await events_pass()
    future.set_exception(Unreachable("no"))
    await events_pass()
    waits.see([], 3)
    await events_pass()
    assert answers.sent == []
    now = record(axis_state=AxisState.ENABLED)
    waits.see([], 4)
    await events_pass()
    assert answers.sent[0]["result"] == {"state": AxisState.ENABLED}


@on_event_loop
async def test_full_disk_ends_the_request_only() -> None:
    requests, answers, future = Requests(), _Answers(), Future[int]()

    async def request() -> dict[str, Any]:
        return {"found": await work_of(future)}

    requests.start(request(), answers.reply())
    future.set_exception(OSError(28, "No space left on device", "active.json"))
    await events_pass()
    told = answers.sent[0]["error"]
    assert (told["exit_code"], told["message"]) == (3, "active.json: no space left on device")
    assert {told["where"], told["found"], told["allowed"]} == {None}


@on_event_loop
async def test_mistake_in_a_request_ends_that_request_only() -> None:
    requests, answers = Requests(), _Answers()

    async def request() -> dict[str, Any]:
        raise KeyError("nobody foresaw this")

    requests.start(request(), answers.reply())
    assert "nobody foresaw" in answers.sent[0]["error"]["message"]


@on_event_loop
async def test_request_that_is_cancelled_cleans_up_and_answers_nothing() -> None:
    """At the daemon's end; its first step ran outside of its task."""
    waits, requests, answers, cleaned = Waits(), Requests(), _Answers(), []

    async def request() -> dict[str, Any]:
        try:
            await waits.order(1, 0)
        finally:
            cleaned.append(True)
        return {}

    requests.start(request(), answers.reply())
    for task in asyncio.all_tasks() - {asyncio.current_task()}:
        task.cancel()
    await events_pass()
    assert (cleaned, answers.sent) == ([True], [])


def test_request_that_waits_cannot_be_finished_in_virtual_time() -> None:
    async def request() -> dict[str, Any]:
        await asyncio.sleep(0)
        return {}

    with pytest.raises(RuntimeError, match="waits for what does not come"):
        finish(request())


# --- verbs ------------------------------------------------------------------------------------------------------------
class _Loop:
    """What the verbs need of the loop's handle, with a loop that answers when it is told to."""

    proofs = (0, None)

    def __init__(self) -> None:
        self.sent: list[Op] = []
        self.arguments: Sequence[float] = ()
        self.latest = record(1, axis_state=AxisState.ENABLED)
        self.seq = 0
        self.area: list[float] = []

    def send(self, op: Op, arguments: Sequence[float] = ()) -> int:
        self.sent.append(op)
        self.arguments = arguments
        self.seq += 1
        return self.seq

    def write_trajectory(self, positions_rad: Sequence[float]) -> None:
        self.area = list(positions_rad)


class _Events:
    def add_event(self, *_: Any, **__: Any) -> None:
        """Nothing is recorded here."""


class _Bank:
    on_trial = False

    def require_own_devices(self) -> None:
        """They are."""


def _same(bus: Bus) -> Bus:
    return bus


def _proven() -> GuardTestStatus:
    return GuardTestStatus(asked_for=False, holds=True, time=None, text="")


@pytest.fixture
def verbs(tmp_path: Path) -> Iterator[tuple[Verbs, _Loop]]:
    loop, config = _Loop(), axis_config(tmp_path / "s", tmp_path / "c")
    config = config.model_copy(update={"limits": config.limits.model_copy(update={"speed_rad_s": 1e3})})
    verbs = Verbs(
        config, cast(LoopHandle, loop), cast(GainBank, _Bank()), cast(Recorder, _Events()), dict, dict, _same, _proven
    )
    yield verbs, loop
    verbs.close()


def test_cycles_go_out_in_pieces_and_what_left_the_memory_is_counted(tmp_path: Path) -> None:
    config = axis_config(tmp_path / "s", tmp_path / "c")
    recorder = Recorder(RecorderConfig(directory=tmp_path, history_s=0.0), "axis", 1000)
    verbs = Verbs(config, cast(LoopHandle, _Loop()), cast(GainBank, _Bank()), recorder, dict, dict, _same, _proven)

    class _Client:
        path = "axis.sock"

        def call(self, verb: Verb, **args: Any) -> dict[str, Any]:
            answers = _Answers()
            verbs.handle(verb, args, answers.reply())
            result: dict[str, Any] = json.loads(encode_line(answers.sent[0]))["result"]
            return result

    recorder.add_rows(rows(5))
    stream = CycleStream(cast(ControlClient, _Client()))
    assert stream.count_rad == pytest.approx(2.0 * math.pi / config.encoder.counts_per_turn)
    assert stream.take() == row(4, position_rad=0.004)
    assert stream.take() == b""
    recorder.add_rows(rows(2 * PIECE_CYCLES, 5))
    assert stream.take() == b"".join(rows(2 * PIECE_CYCLES, 5))
    recorder.add_rows([row(2000, position_rad=math.nan)])
    assert math.isnan(CycleRecord.unpack(stream.take()).position_rad)
    assert stream.lost == 0
    recorder.add_rows(rows(2300, 3000))
    assert stream.take() == b"".join(rows(2000, 3300))  # two seconds are kept, however short the history
    assert stream.lost == 300
    recorder.close()
    verbs.close()


async def _csv(verbs: Verbs, positions: list[float], **more: Any) -> list[dict[str, Any]]:
    answers = _Answers()
    verbs.handle(Verb.TRACK, {"kind": "csv", "positions_rad": positions, **more}, answers.reply())
    await events_pass()
    return answers.sent


@on_event_loop
async def test_trajectory_is_in_use_from_its_command_to_the_motions_end(verbs: tuple[Verbs, _Loop]) -> None:
    front, loop = verbs
    assert await _csv(front, [0.0, 0.1, 0.2]) == []
    first = loop.area
    for seen in ({}, {"command_seq": 1, "reference_active": 1}):
        loop.latest = record(2, axis_state=AxisState.ENABLED, **seen)
        assert front.motion_running()
        (answer,) = await _csv(front, [0.3, 0.3, 0.3])
        assert "a motion is running" in answer["error"]["message"]
        assert (loop.area, loop.seq) == (first, 1)
    loop.latest = record(3, axis_state=AxisState.ENABLED, command_seq=1)
    assert await _csv(front, [0.3, 0.3, 0.3]) == []
    assert loop.area == [0.3, 0.3, 0.3]


@on_event_loop
async def test_check_alone_moves_nothing_and_tells_what_is_wrong(verbs: tuple[Verbs, _Loop]) -> None:
    front, loop = verbs
    loop.latest = record(1, axis_state=AxisState.DISABLED)
    (good,) = await _csv(front, [0.0, 0.1], start_immediately=False)
    assert good["result"]["duration_s"] == pytest.approx(0.001)
    (bad,) = await _csv(front, [0.0, 2.0], start_immediately=False)
    assert "position_max_rad" in bad["error"]["message"]
    assert (loop.area, loop.seq) == ([], 0)


@on_event_loop
async def test_samples_of_a_client_that_left_are_void(verbs: tuple[Verbs, _Loop]) -> None:
    front, _ = verbs
    args = {"key": "positions_rad", "start": 0, "samples": [0.0, 0.1]}
    front.handle(Verb.TRAJECTORY, args, _Answers().reply())
    front.lease_ended()
    answers = _Answers()
    front.handle(Verb.TRACK, {"kind": "csv", "uploaded": True}, answers.reply())
    assert "found 0 samples" in answers.sent[0]["error"]["message"]


@pytest.mark.parametrize("before", [AxisState.DISABLED, AxisState.ENABLED])
@pytest.mark.parametrize("seen", [AxisState.ENABLING, AxisState.PROVING, AxisState.ENABLED])
@on_event_loop
async def test_axis_that_was_off_is_not_enabled_for_a_client_that_left(
    verbs: tuple[Verbs, _Loop], seen: AxisState, before: AxisState
) -> None:
    front, loop = verbs
    loop.latest = record(1, axis_state=before)
    front.handle(Verb.ENABLE, {}, _Answers().reply())
    loop.latest = record(2, axis_state=seen, command_seq=1)
    for _ in range(2):
        front.tick([loop.latest], time.monotonic_ns())
        await events_pass()
    front.lease_ended()
    assert loop.sent == [Op.ENABLE, Op.DISABLE][: 1 if AxisState.ENABLED in (seen, before) else 2]


@on_event_loop
async def test_enabling_is_confirmed_with_what_the_loop_answered(verbs: tuple[Verbs, _Loop]) -> None:
    front, loop = verbs
    answers = _Answers()
    loop.latest = record(1, axis_state=AxisState.DISABLED)
    front.handle(Verb.ENABLE, {}, answers.reply())
    loop.latest = record(2, axis_state=AxisState.DISABLED, command_seq=1, command_result=-77)
    front.tick([loop.latest], time.monotonic_ns())
    await events_pass()
    assert (loop.sent, loop.arguments) == ([Op.ENABLE, Op.CONFIRM], (-77,))
    loop.latest = record(3, axis_state=AxisState.ENABLED, command_seq=2)
    for _ in range(2):
        front.tick([loop.latest], time.monotonic_ns())
        await events_pass()
    assert answers.sent[0]["result"]["state"] == "ENABLED"


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
@on_event_loop
async def test_stop_that_stopped_nothing_is_no_success(
    verbs: tuple[Verbs, _Loop], verb: Verb, now: dict[str, int], says: str
) -> None:
    front, loop = verbs
    answers = _Answers()
    front.handle(verb, {}, answers.reply())
    loop.latest = record(2, command_seq=1, **now)
    front.tick([loop.latest], time.monotonic_ns())
    await events_pass()
    front.tick([], time.monotonic_ns())
    await events_pass()
    assert answers.sent == []
    front.tick([], time.monotonic_ns() + 60_000_000_000)
    await events_pass()
    assert answers.sent[0]["error"]["exit_code"] == 3
    assert says in answers.sent[0]["error"]["message"]


@pytest.mark.parametrize("verb", [Verb.STOP, Verb.DISABLE])
@on_event_loop
async def test_an_enable_that_is_read_behind_a_stop_that_has_no_answer_yet_is_void(
    verbs: tuple[Verbs, _Loop], verb: Verb
) -> None:
    """Two connections are not always read in the order that they wrote: the stop may have come after it."""
    front, loop = verbs
    off = {"axis_state": AxisState.DISABLED, "drive_state": DriveState.SWITCH_ON_DISABLED}
    loop.latest = record(1, **off)
    stopped, enabled = _Answers(), _Answers()
    front.handle(verb, {}, stopped.reply())
    front.handle(Verb.ENABLE, {}, enabled.reply())
    assert "somebody stops the axis" in enabled.sent[0]["error"]["message"]
    for _ in range(2):
        loop.latest = record(2, command_seq=1, **off)
        front.tick([loop.latest], time.monotonic_ns())
        await events_pass()
    assert stopped.sent[0]["ok"] and Op.ENABLE not in loop.sent
    front.handle(Verb.ENABLE, {}, _Answers().reply())
    assert loop.sent[-1] is Op.ENABLE


@pytest.mark.parametrize("how", ["the queue is full", "no answer", "not off"])
@on_event_loop
async def test_a_stop_that_failed_keeps_nobody_from_enabling(
    verbs: tuple[Verbs, _Loop], monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    front, loop = verbs
    loop.latest = record(1, axis_state=AxisState.ENABLED)
    answers = _Answers()

    def full(_op: Op, _arguments: Sequence[float] = ()) -> int:
        raise Unreachable("the command queue is full")

    with monkeypatch.context() as patch:
        if how == "the queue is full":
            patch.setattr(loop, "send", full)
        front.handle(Verb.STOP, {}, answers.reply())
        await events_pass()
    if how == "not off":
        front.tick([record(2, command_seq=1, axis_state=AxisState.ENABLED)], time.monotonic_ns())
        await events_pass()
    front.tick([], time.monotonic_ns() + 60_000_000_000)
    await events_pass()
    assert not answers.sent[0]["ok"]
    front.handle(Verb.ENABLE, {}, _Answers().reply())
    assert loop.sent[-1] is Op.ENABLE


@on_event_loop
async def test_stops_one_after_the_other_are_one_command_until_the_loop_has_taken_it(
    verbs: tuple[Verbs, _Loop],
) -> None:
    front, loop = verbs
    answers = _Answers()
    for _ in range(20):
        front.handle(Verb.STOP, {}, answers.reply())
    assert loop.seq == 1
    front.handle(Verb.HALT, {"on": True}, answers.reply())
    front.handle(Verb.STOP, {}, answers.reply())  # something came between: this one counts again
    assert loop.seq == 3
    off = {"axis_state": AxisState.DISABLED, "drive_state": DriveState.SWITCH_ON_DISABLED}
    loop.latest = record(2, command_seq=3, **off)
    front.tick([record(1, command_seq=1), record(2, command_seq=2), loop.latest], time.monotonic_ns())
    await events_pass()
    front.tick([], time.monotonic_ns())
    await events_pass()
    assert [a["ok"] for a in answers.sent] == [True] * 22
    front.handle(Verb.STOP, {}, answers.reply())
    assert loop.seq == 4


def test_queue_that_a_client_floods_leaves_room_for_stops_and_node_events() -> None:
    channel = Channel()
    taken = {op: sum(channel.send(op) > 0 for _ in range(16)) for op in _FLOOD}
    assert taken == {Op.HALT: 8, Op.DISABLE: 2, Op.QUICK_STOP: 2, Op.NODE_EVENT: 4}
    channel.close()


_FLOOD = (Op.HALT, Op.DISABLE, Op.QUICK_STOP, Op.NODE_EVENT)
