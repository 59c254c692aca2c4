"""The control socket's protocol and its client: one JSON object per line over a Unix stream socket.

Between command line and daemon. Request `{"id": 1, "verb": "status", "args": {}}`, answer `{"id": 1, "ok": true,
"result": {...}}` or `{"id": 1, "ok": false, "error": {"exit_code": 3, "message": "one line", "where": null, "found":
null, "allowed": null}}`, the last three as texts where bad input was found. Requests are short, so that reading one
never holds the daemon up: a long table of samples goes ahead of its motion in pieces. The server side is
servod.runtime.daemon.control_server.
"""

from __future__ import annotations

import base64
import binascii
import math
import socket
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

from servod.common.errors import AnswerIsNo, BadInput, Details, ServodError, Unreachable, one_line
from servod.common.files import reason
from servod.common.portable import need_linux
from servod.formats.protocol import (
    MAX_ANSWER_BYTES,
    MAX_LINE_BYTES,
    PIECE_CYCLES,
    PIECE_SAMPLES,
    SampleKey,
    Verb,
    decode_line,
    encode_line,
)
from servod.formats.recording.record import RECORD

_TIMEVAL = struct.Struct("@ll")


class RemoteBadInput(BadInput):
    """Bad input that the daemon found; carries its line as it stands, and its parts where the daemon tells them."""

    def __init__(self, line: str, where: object = None, found: object = None, allowed: object = None) -> None:
        ServodError.__init__(self, line)
        parts = (where, found, allowed)
        structured = all(isinstance(part, str) for part in parts)
        self.where, self.found, self.allowed = map(str, parts if structured else ("daemon", line, ""))


class Refused(Unreachable):
    """The daemon answered, and did not do it: a limit, a state, somebody else who commands."""


_ERRORS: dict[int, type[ServodError]] = {1: AnswerIsNo, 2: RemoteBadInput, 3: Refused}


class ControlClient:
    """One connection to a running daemon; holds the right to command, once used, until it is closed."""

    def __init__(self, path: str | Path, timeout_s: float = 30.0) -> None:
        self._path = str(path)
        self._id = 0
        need_linux(f"{path}: to talk to a daemon")
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_CLOEXEC)
        # A socket that does not block is refused by a full queue; one that blocks stands in it, for this time.
        longest = _TIMEVAL.pack(*divmod(int(timeout_s * 1e6), 1_000_000))
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, longest)
        try:
            self._socket.connect(self._path)
            self._socket.settimeout(timeout_s)
        except PermissionError:
            self._socket.close()
            raise Unreachable(f"{path}: permission denied; only members of the control group may connect") from None
        except OSError as error:
            self._socket.close()
            raise Unreachable(f"{path}: no daemon answers ({_why(error)}); is servod running?") from None
        self._lines = self._socket.makefile("rb")

    def __enter__(self) -> ControlClient:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close()

    @property
    def path(self) -> str:
        """The socket's."""
        return self._path

    def close(self) -> None:
        """Leave; gives back the right to command."""
        self._lines.close()
        self._socket.close()

    def call(self, verb: Verb | str, **args: Any) -> dict[str, Any]:
        """Ask and wait for the answer's result. Raises Unreachable, BadInput or AnswerIsNo by its exit code.

        Samples of a motion that are too many for one request are sent ahead in pieces.
        """
        self._ask(verb, self._send_ahead(args) if verb == Verb.TRACK else args)
        while True:
            answer = self._answer()
            if answer.get("id") in (self._id, None):  # no number: what the daemon says of the connection itself
                return _result(answer)

    def watch(self, period_s: float = 0.2) -> Iterator[dict[str, Any]]:
        """Status after status until the daemon stops or the connection is closed; raises as `call` does."""
        self._ask(Verb.WATCH, {"period_s": period_s})
        while True:
            yield _result(self._answer())

    def _send_ahead(self, args: dict[str, Any]) -> dict[str, Any]:
        """Upload the samples in `args` when they are many; gives the arguments that remain."""
        tables = {key: args[key] for key in SampleKey if isinstance(args.get(key), Sequence)}
        if sum(map(len, tables.values())) <= PIECE_SAMPLES:
            return args
        for key, samples in tables.items():
            for start in range(0, len(samples), PIECE_SAMPLES):
                self.call(Verb.TRAJECTORY, key=key, start=start, samples=samples[start : start + PIECE_SAMPLES])
        return {key: value for key, value in args.items() if key not in tables} | {"uploaded": True}

    def _ask(self, verb: Verb | str, args: dict[str, Any]) -> None:
        self._id += 1
        try:
            line = encode_line({"id": self._id, "verb": str(verb), "args": args})
        except ValueError:
            key, found = next(_not_finite(args), ("", "a number that is not finite"))
            raise BadInput(f"{verb}{key}", found, "finite numbers") from None
        if len(line) > MAX_LINE_BYTES:
            raise BadInput(f"{verb}", f"{len(line)} bytes", f"at most {MAX_LINE_BYTES} bytes in a request")
        try:
            self._socket.sendall(line)
        except TimeoutError:
            raise Unreachable(f"{self._path}: the daemon does not read") from None
        except OSError:
            _result(self._answer())  # it hung up; what it said before stands in the socket
            raise Unreachable(f"{self._path}: the daemon hung up") from None

    def _answer(self) -> dict[str, Any]:
        if self._lines.closed:
            raise Unreachable(f"{self._path}: this connection was closed")
        try:
            line = self._lines.readline(MAX_ANSWER_BYTES)
        except TimeoutError:
            raise Unreachable(f"{self._path}: no answer within {self._socket.gettimeout()} s") from None
        except OSError as error:
            raise Unreachable(f"{self._path}: the daemon hung up ({reason(error)})") from None
        if not line.endswith(b"\n"):
            raise Unreachable(f"{self._path}: the daemon hung up")
        try:
            return decode_line(line)
        except ValueError as error:
            raise Unreachable(f"{self._path}: answers with something else than servod would ({error})") from None


def _not_finite(args: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Key and value of each argument that JSON has no number for."""
    for key, value in args.items():
        samples = value if isinstance(value, list | tuple) else [value]
        yield from ((f": {key}", str(x)) for x in samples if isinstance(x, float) and not math.isfinite(x))


class CycleStream:
    """The cycle records of a running axis as they come, from the daemon's memory: nothing is recorded for it.

    The daemon holds the last seconds; `lost` counts those that a reader who came too late did not get.
    """

    def __init__(self, client: ControlClient) -> None:
        """Begin with the newest record, which is from before all that is asked for from now on. Raises as
        ControlClient.call.
        """
        self._client = client
        now = client.call(Verb.CYCLES)
        self._last, self.count_rad, self.lost = max(int(now["last"]) - 1, 0), float(now["count_rad"]), 0

    def take(self) -> bytes:
        """All records since the last time, packed, oldest first. Raises as ControlClient.call."""
        taken = b""
        while True:
            answer = self._client.call(Verb.CYCLES, after=self._last)
            try:
                raw = base64.b64decode(answer["records"], validate=True)
            except binascii.Error:
                raise Unreachable(f"{self._client.path}: answers with something else than servod would") from None
            count = len(raw) // RECORD.size
            self.lost += int(answer["last"]) - self._last - count
            self._last = int(answer["last"])
            taken += raw
            if count < PIECE_CYCLES:
                return taken


def _why(error: OSError) -> str:
    """What a socket that nobody answers at means."""
    if isinstance(error, FileNotFoundError):
        return "there is no such socket"
    return "nobody listens there" if isinstance(error, ConnectionRefusedError) else reason(error)


def _result(answer: dict[str, Any]) -> dict[str, Any]:
    if answer.get("ok"):
        result = answer.get("result")
        return result if isinstance(result, dict) else {}
    error = answer.get("error")
    if not isinstance(error, dict):
        raise Unreachable("the daemon refused and gave no reason")
    code = error.get("exit_code")
    kind = _ERRORS.get(code, Unreachable) if isinstance(code, int) else Unreachable
    if kind is Refused and answer.get("id") is None:  # of the connection: no request was refused
        kind = Unreachable
    line = one_line(error.get("message", "refused"))
    if kind is RemoteBadInput:
        raise RemoteBadInput(line, *(error.get(part) for part in Details._fields))
    raise kind(line)
