"""Targets at the control socket: what clients may send to the daemon, and what may answer a client."""

from __future__ import annotations

import asyncio
import json
import logging
import socket
import threading
import time
from collections.abc import Callable, Sequence
from itertools import count
from pathlib import Path
from typing import Any, cast

from servod.client.control import ControlClient
from servod.formats.config import AxisConfig
from servod.formats.protocol import Verb
from servod.formats.recording.record import FIELDS, CycleRecord
from servod.runtime.daemon.control_server import ControlServer
from servod.runtime.daemon.gain_bank import GainBank
from servod.runtime.daemon.guard_test import GuardTestStatus
from servod.runtime.daemon.recorder import Recorder
from servod.runtime.daemon.verbs import Verbs
from servod.runtime.loop.axis_state import AxisState
from servod.runtime.loop.commands import Op
from servod.runtime.loop.handle import LoopHandle
from servod.runtime.loop.plan import LoopPlan
from tests.axis_limits import LIMITS
from tests.fuzz.shapes import JSON_TRICKS, request_lines
from tests.fuzz.target import Target
from tests.fuzz.texts import _GAINS
from tests.on_event_loop import events_pass

_REQUESTS: tuple[dict[str, Any], ...] = tuple(
    {"id": number, "verb": str(verb), "args": args}
    for number, (verb, args) in enumerate(
        (
            (Verb.STATUS, {}),
            (Verb.WATCH, {"period_s": 0.2}),
            (Verb.ENABLE, {"reset_fault": True}),
            (Verb.STOP, {}),
            (Verb.HALT, {"on": True}),
            (Verb.TRAJECTORY, {"key": "positions_rad", "start": 0, "samples": [0.0, 0.1]}),
            (Verb.TRACK, {"kind": "sine", "amplitude_rad": 0.1, "frequency_hz": 0.5, "duration_s": 4}),
            (Verb.TRACK, {"kind": "csv", "positions_rad": [0.0, 0.001], "start_immediately": False}),
            (Verb.TRACK, {"kind": "excite", "uploaded": True, "window_rad": 0.1, "torques_nm": [0.0]}),
            (Verb.GAINS_LOAD, {"name": "trial", "text": _GAINS.decode()}),
            (Verb.GAINS_LIST, {}),
            (Verb.GAINS_ACTIVATE, {"name": "trial", "version": 1, "trial": True}),
            (Verb.GAINS_KEEP, {"note": "x", "figures": {"a": 1.0}}),
            (Verb.GAINS_ROLLBACK, {"trial": True}),
            (Verb.RECORD_START, {"path": "run.mcap"}),
            (Verb.RECORD_STOP, {}),
            (Verb.CYCLES, {"after": 0}),
        )
    )
)
#: Rounds of the event loop that an answer may take; and those in which the server sees that a client has left.
_ROUNDS, _ROUNDS_TO_LEAVE = 200, 6
#: They take at least so long: the recorder works in a thread of its own.
_RECORDER_NS = 60_000_000


class _Loop(LoopHandle):
    """A loop that takes every command at once; what it would do then is not the requests' matter."""

    def __init__(self) -> None:
        super().__init__(cast(LoopPlan, None))  # nothing is started
        record = CycleRecord._make(0 if f.kind == "q" else 0.0 for f in FIELDS)
        self.latest: CycleRecord = record._replace(axis_state=AxisState.ENABLED)

    def send(self, op: Op, arguments: Sequence[float] = ()) -> int:
        assert all(isinstance(float(argument), float) for argument in arguments)
        self.latest = self.latest._replace(command_seq=self.latest.command_seq + 1, cycle=self.latest.cycle + 1)
        return int(self.latest.command_seq)


class _Mistakes(logging.Handler):
    """What went wrong in the coroutine of a client, which is logged and ends that client alone."""

    def __init__(self) -> None:
        super().__init__(logging.ERROR)
        self.found: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.found.append(f"{record.getMessage()}: {record.exc_info and record.exc_info[1]!r}")


class _Desk:
    """Server, verbs, gain store and recorder as the supervisor has them, in one thread, driven by hand."""

    def __init__(self, folder: Path) -> None:
        (folder / "gains.yaml").write_bytes(_GAINS)
        (folder / "recordings").mkdir(exist_ok=True)
        self.config = AxisConfig.model_validate(
            {
                "limits": LIMITS,
                "gains": {"initial": folder / "gains.yaml", "directory": folder / "store", "accept_uncertified": True},
                "control": {"socket": folder / "axis.sock"},
                "recorder": {"directory": folder / "recordings"},
            }
        )
        self.loop = _Loop()
        recorder = Recorder(self.config.recorder, self.config.name, 1000)
        bank = GainBank(self.config)
        proof = GuardTestStatus(asked_for=False, holds=True, time=None, text="")
        self.verbs = Verbs(self.config, self.loop, bank, recorder, dict, dict, lambda bus: bus, lambda: proof)
        self.server = ControlServer(self.config.control, self.verbs)
        self._events = asyncio.Runner()
        self._events.get_loop().call_soon(self.server.begin)

        self.mistakes = _Mistakes()
        logging.getLogger("servod.control").addHandler(self.mistakes)

    def rounds(self, until: Callable[[], bool]) -> None:
        """Rounds of the supervisor's event loop, until there is nothing more to wait for."""
        self._events.run(self._rounds(until))

    async def _rounds(self, until: Callable[[], bool]) -> None:
        begun_ns = time.monotonic_ns()
        for number in count():
            if number >= _ROUNDS and time.monotonic_ns() - begun_ns > _RECORDER_NS:
                return
            await events_pass()
            self.verbs.slow.submit(lambda: None).result()
            now_ns = time.monotonic_ns()
            self.verbs.tick([self.loop.latest], now_ns)
            self.server.tick(now_ns)
            if until():
                return


def control_server(folder: Path) -> Target:
    """Lines to the daemon: each gets an answer, foreseen errors alone, and the next client is served."""
    desk = _Desk(folder)

    def run(data: bytes) -> None:
        answers = _talk(desk, data)
        for answer in answers:
            assert answer["ok"] or "servod failed" not in answer["error"]["message"], answer
            assert answer["ok"] or len(answer["error"]["message"]) < 1500, answer
        assert not desk.mistakes.found, desk.mistakes.found
        good = _talk(desk, b'{"id": 7, "verb": "status", "args": {}}\n')
        assert {"id": 7, "ok": True, "result": {}} in good, good
        outside = [p.name for p in folder.iterdir() if p.name not in _OWN]
        assert not outside, outside

    lines = tuple(json.dumps(request).encode() + b"\n" for request in _REQUESTS)
    words = (*(f'"{verb}"'.encode() for verb in Verb), b'"args":', b"NaN", b"1e999", b"\\ud800", b"../", b"\n")
    return Target(run, (*lines, b"".join(lines)), request_lines(_REQUESTS), words)


_OWN = {"gains.yaml", "store", "recordings", "axis.sock"}


def _talk(desk: _Desk, data: bytes) -> list[dict[str, Any]]:
    """One client that sends `data` and leaves; every line that it got."""
    client = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    client.connect(str(desk.config.control.socket))
    client.setblocking(False)
    got, left = bytearray(), memoryview(data)

    def exchange() -> bool:
        nonlocal left
        try:
            left = left[client.send(left) :] if left else left
            got.extend(client.recv(1 << 20))
        except (BlockingIOError, ConnectionError, BrokenPipeError):
            pass
        return not left and got.count(b"\n") >= data.count(b"\n")

    desk.rounds(exchange)
    client.close()
    rounds = iter(range(_ROUNDS_TO_LEAVE))
    desk.rounds(lambda: next(rounds, None) is None)
    return [json.loads(line) for line in got.splitlines() if line]


def control_client(folder: Path) -> Target:
    """Answers to a client from something that is no servod."""
    path = folder / "odd.sock"
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    listener.bind(str(path))
    listener.listen(1)

    def answer(data: bytes) -> None:
        server, _ = listener.accept()
        with server:
            server.recv(65536)
            server.sendall(data)

    def run(data: bytes) -> None:
        thread = threading.Thread(target=answer, args=(data,), daemon=True)
        thread.start()
        try:
            with ControlClient(path, timeout_s=2.0) as client:
                client.call(Verb.STATUS)
        finally:
            thread.join(5.0)

    seeds = (
        b'{"id": 1, "ok": true, "result": {"state": "DISABLED"}}\n',
        b'{"id": 1, "ok": false, "error": {"exit_code": 3, "message": "no"}}\n',
        b'{"id": 1, "ok": false, "error": {"exit_code": [], "message": 1}}\n{"id": 1, "ok": false, "error": "x"}\n',
    )
    requests = [json.loads(seed.splitlines()[0]) for seed in seeds]
    return Target(run, seeds, request_lines(requests), (b'"ok":', b'"error":', *JSON_TRICKS[:2]))
