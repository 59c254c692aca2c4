"""A control server in a thread of its own, with a handler that answers with what it was asked."""

from __future__ import annotations

import asyncio
import json
import socket
import threading
import time
from pathlib import Path
from typing import Any

from servod.common.errors import AnswerIsNo, BadInput, Unreachable
from servod.formats.config import ControlConfig
from servod.formats.protocol import Verb
from servod.runtime.daemon.connection import Reply
from servod.runtime.daemon.control_server import ControlServer

_ROUND_S = 0.02


class Echo:
    """A handler that answers with what it was asked; `late_verbs` wait, while `patient`; `scan` fails as told."""

    def __init__(self) -> None:
        self.late: list[Reply] = []
        self.late_verbs = {Verb.STOP}
        self.answer: dict[str, Any] | None = None  # to what is not late
        self.moves = self.broken = self.patient = False
        self.ended_leases = 0
        self.renew_ns: int | None = None
        self.abandoned: list[str] = []
        self.held_up_s = 0.0
        self.asked: list[Verb] = []
        self.pieces: list[tuple[str, int, list[float]]] = []

    def handle(self, verb: Verb, args: dict[str, Any], reply: Reply) -> None:
        self.asked.append(verb)
        if verb in self.late_verbs:
            self.late.append(reply)
        elif self.answer is not None:
            reply.done(self.answer)
        elif verb is Verb.SCAN:
            raise {1: AnswerIsNo("no"), 2: BadInput("scan", 1, "2"), 3: Unreachable("gone\nreally")}[args["code"]]
        elif verb is Verb.TRAJECTORY:
            self.pieces.append((args["key"], args["start"], args["samples"]))
            reply.done({})
        elif verb is Verb.GAINS_LIST:
            raise KeyError("nobody foresaw this")
        else:
            reply.done({"verb": verb, "args": args})

    def status(self) -> dict[str, Any]:
        if self.broken:
            raise ZeroDivisionError("a bad byte")
        return {"now": time.monotonic()}

    def motion_running(self) -> bool:
        return self.moves

    def lease_ended(self) -> None:
        self.ended_leases += 1

    def abandon_motion(self, why: str) -> None:
        self.abandoned.append(why)


class Served:
    """A control server in a thread of its own."""

    def __init__(self, path: Path) -> None:
        self.path, self.handler = path, Echo()
        self.server = ControlServer(ControlConfig(socket=path), self.handler)
        self._stop = threading.Event()
        self._why = ""
        self.longest_round_s = 0.0
        self._thread = threading.Thread(target=lambda: asyncio.run(self._run()))
        self._thread.start()

    async def _run(self) -> None:
        """As the supervisor's rounds; the longest is all that was done between two of them, of all clients."""
        self.server.begin()
        while not self._stop.is_set():
            began = time.monotonic()
            self.server.tick(time.monotonic_ns())
            self._answer_late()
            time.sleep(self.handler.held_up_s)  # on the event loop: as a supervisor that gets no processor
            self.handler.held_up_s = 0.0
            await asyncio.sleep(_ROUND_S)
            self.longest_round_s = max(self.longest_round_s, time.monotonic() - began - _ROUND_S)
        self.server.close(self._why)

    def _answer_late(self) -> None:
        if not self.handler.patient:
            for reply in self.handler.late:
                reply.done({"late": True})
            self.handler.late.clear()

    def close(self, why: str = "enough") -> None:
        """Stop the thread and the server, once."""
        if not self._stop.is_set():
            self._why = why
            self._stop.set()
            self._thread.join()


def raw(served: Served) -> socket.socket:
    """A bare connection."""
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    connection.connect(str(served.path))
    connection.settimeout(5)
    return connection


def answer_of(connection: socket.socket) -> dict[str, Any]:
    """The next line."""
    with connection.makefile("rb") as lines:
        return json.loads(lines.readline())  # type: ignore[no-any-return]
