"""Server side of the control socket: clients in, requests out, answers back, and never a moment of waiting.

Runs inside the supervisor's event loop; sockets do not block. A client that is slow, broken or malicious loses its own
connection and nothing else: lines, buffers and the number of clients are bounded. Only one client at a time may
command: the first that does holds the lease until it disconnects. Protocol: servod.control.
"""

from __future__ import annotations

import errno
import os
import selectors
import socket
import stat
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

from servod.config import ControlConfig
from servod.control import MAX_LINE_BYTES, READING, Verb, decode_line, encode_line
from servod.daemon.peer import Peer, group_id, may_command, peer_of
from servod.daemon.status import LeaseStatus
from servod.errors import BadInput, ServodError, Unreachable
from servod.units import NS_PER_S

_MAX_CLIENTS = 32
_BACKLOG = 128
_ACCEPT_AT_ONCE = 16
_READ_BYTES = 65_536
_MAX_BACKLOG_BYTES = 4 * 1024 * 1024
_WATCH_BACKLOG_BYTES = 64 * 1024
_MIN_WATCH_S, _MAX_WATCH_S = 0.02, 60.0

#: Anyone who may command may stop the axis, whoever holds the lease.
_WITHOUT_LEASE = frozenset({Verb.STOP})


class Reply:
    """The answer to one request, now or later; answering a client that has gone does nothing."""

    def __init__(self, send: Callable[[dict[str, Any]], None], number: Any) -> None:
        self._send, self._number = send, number

    def done(self, result: dict[str, Any]) -> None:
        """The request was carried out."""
        self._send({"id": self._number, "ok": True, "result": result})

    def failed(self, error: ServodError) -> None:
        """The request was refused; one line and the exit code for the command line."""
        answer = {"exit_code": error.exit_code, "message": " ".join(str(error).split())}
        self._send({"id": self._number, "ok": False, "error": answer})


class Handler(Protocol):
    """What carries requests out; both methods return at once."""

    def handle(self, verb: Verb, args: dict[str, Any], reply: Reply) -> None:
        """Carry out one request; answers through `reply`, at once or later. May raise ServodError."""
        ...

    def status(self) -> dict[str, Any]:
        """The status document for watchers."""
        ...


class ControlServer:
    """The listening socket and its clients."""

    def __init__(self, config: ControlConfig, selector: selectors.BaseSelector, handler: Handler) -> None:
        """Bind and listen. Raises Unreachable when that is refused. The caller holds the instance lock."""
        self._path, self._selector, self._handler = config.socket, selector, handler
        self._group = group_id(config.group)
        self._clients: set[_Client] = set()
        self._holder: _Client | None = None
        self._listener = _listen(config.socket, self._group)
        selector.register(self._listener, selectors.EVENT_READ, self._accept)

    def tick(self, now_ns: int) -> None:
        """Send watchers what is due; call it in every round of the event loop."""
        due = [c for c in self._clients if c.watch_due(now_ns)]
        if not due:
            return
        try:
            status = self._handler.status()
        except ServodError:
            return  # before the first cycle there is nothing to watch yet
        for client in due:
            client.send_watch(status, now_ns)

    def lease(self) -> LeaseStatus:
        """Who commands; pid 0 when nobody does."""
        peer = self._holder.peer if self._holder else None
        return {"pid": peer.pid if peer else 0, "uid": peer.uid if peer else 0}

    def close(self) -> None:
        """Hang up on everyone and remove the socket."""
        for client in list(self._clients):
            self.drop(client)
        self._selector.unregister(self._listener)
        self._listener.close()
        self._path.unlink(missing_ok=True)

    def drop(self, client: _Client) -> None:
        """Forget a client that has gone or must go; gives its lease back."""
        if client in self._clients:
            self._clients.remove(client)
            client.close()
        if self._holder is client:
            self._holder = None

    def _accept(self, _events: int) -> None:
        for _ in range(_ACCEPT_AT_ONCE):
            try:
                connection, _address = self._listener.accept()
            except OSError:
                return  # nobody waits, or descriptors ran out: nothing to hold against the axis
            if len(self._clients) >= _MAX_CLIENTS:
                connection.close()
                continue
            connection.setblocking(False)
            self._clients.add(_Client(connection, self._selector, self))

    def dispatch(self, client: _Client, line: bytes) -> None:
        """One request line: check it, check the right to ask it, and hand it on."""
        number: Any = None
        try:
            message = decode_line(line)
            number = message.get("id")
            verb, args = _request(message)
            self._check_right(client, verb)
            reply = Reply(client.send, number)
            if verb is Verb.WATCH:
                client.start_watch(args, reply)
            else:
                self._handler.handle(verb, args, reply)
        except ServodError as error:
            Reply(client.send, number).failed(error)
        except ValueError as error:
            Reply(client.send, number).failed(BadInput("request", str(error)[:200], "one JSON object per line"))

    def _check_right(self, client: _Client, verb: Verb) -> None:
        if verb in READING:
            return
        if not may_command(client.peer, self._group):
            raise Unreachable(f"user {client.peer.uid} may not command this axis: not in the control group")
        if verb in _WITHOUT_LEASE:
            return
        if self._holder not in (None, client):
            assert self._holder is not None
            raise Unreachable(f"process {self._holder.peer.pid} commands the axis; others may watch, or stop it")
        self._holder = client


class _Client:
    """One connection with its two buffers."""

    def __init__(self, connection: socket.socket, selector: selectors.BaseSelector, server: ControlServer) -> None:
        self.peer: Peer = peer_of(connection)
        self._connection, self._selector, self._server = connection, selector, server
        self._incoming, self._outgoing = bytearray(), bytearray()
        self._events = selectors.EVENT_READ
        self._watch_period_ns, self._watch_next_ns = 0, 0
        self._watch_reply: Reply | None = None
        selector.register(connection, self._events, self._on_events)

    def _on_events(self, events: int) -> None:
        if events & selectors.EVENT_WRITE:
            self._flush()
        if events & selectors.EVENT_READ:
            self._read()

    def _read(self) -> None:
        try:
            data = self._connection.recv(_READ_BYTES)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._server.drop(self)
            return
        searched = len(self._incoming)
        self._incoming += data
        self._split(searched)

    def _split(self, searched: int) -> None:
        """Dispatch every complete line; a line without end must not fill the memory."""
        start = 0
        while (end := self._incoming.find(b"\n", max(start, searched))) >= 0:
            line = bytes(self._incoming[start:end])
            start = end + 1
            if line.strip() and self._connection.fileno() >= 0:
                self._server.dispatch(self, line)
        del self._incoming[:start]
        if len(self._incoming) > MAX_LINE_BYTES:
            Reply(self.send, None).failed(BadInput("request", "a longer line", f"at most {MAX_LINE_BYTES} bytes"))
            self._server.drop(self)

    def send(self, message: dict[str, Any]) -> None:
        """Queue one line; a client that does not read its answers is dropped."""
        self._outgoing += encode_line(message)
        self._flush()
        if len(self._outgoing) > _MAX_BACKLOG_BYTES:
            self._server.drop(self)

    def _flush(self) -> None:
        try:
            sent = self._connection.send(self._outgoing) if self._outgoing else 0
        except BlockingIOError:
            sent = 0
        except OSError:
            self._outgoing.clear()
            return  # the read side sees the end and drops the client
        del self._outgoing[:sent]
        self._want(selectors.EVENT_READ | (selectors.EVENT_WRITE if self._outgoing else 0))

    def _want(self, events: int) -> None:
        if events != self._events and self._connection.fileno() >= 0:
            self._selector.modify(self._connection, events, self._on_events)
            self._events = events

    def start_watch(self, args: dict[str, Any], reply: Reply) -> None:
        """Send the status every args["period_s"] from now on."""
        period_s = args.get("period_s", 0.2)
        if not isinstance(period_s, int | float) or not _MIN_WATCH_S <= period_s <= _MAX_WATCH_S:
            raise BadInput("watch: period_s", repr(period_s)[:80], f"{_MIN_WATCH_S} to {_MAX_WATCH_S} seconds")
        self._watch_period_ns, self._watch_next_ns = int(period_s * NS_PER_S), 0
        self._watch_reply = reply

    def watch_due(self, now_ns: int) -> bool:
        """A watcher whose period is over, and that has read what it got."""
        return (
            self._watch_reply is not None
            and now_ns >= self._watch_next_ns
            and len(self._outgoing) < _WATCH_BACKLOG_BYTES
        )

    def send_watch(self, status: dict[str, Any], now_ns: int) -> None:
        """One line for a watcher."""
        if self._watch_reply is not None:
            self._watch_next_ns = now_ns + self._watch_period_ns
            self._watch_reply.done(status)

    def close(self) -> None:
        """Hang up."""
        self._selector.unregister(self._connection)
        self._connection.close()


def _request(message: dict[str, Any]) -> tuple[Verb, dict[str, Any]]:
    name, args = message.get("verb"), message.get("args", {})
    if not isinstance(args, dict):
        raise BadInput("request: args", type(args).__name__, "an object")
    try:
        return Verb(str(name)), args
    except ValueError:
        raise BadInput("request: verb", repr(name)[:80], ", ".join(Verb)) from None


def _listen(path: Path, group: int | None) -> socket.socket:
    """Listen at `path`, for owner and group only, in place of a stale socket; whoever sees it can connect."""
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK)
    aside = path.with_name(f"{path.name}+")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        aside.unlink(missing_ok=True)
        _bind(listener, aside, group)
        listener.listen(_BACKLOG)
        if path.exists() and not stat.S_ISSOCK(path.stat().st_mode):
            raise FileExistsError(errno.EEXIST, "a file that is no socket stands there")
        aside.replace(path)
    except OSError as error:
        listener.close()
        aside.unlink(missing_ok=True)
        raise Unreachable(f"{path}: cannot listen there ({error.strerror or error})") from None
    return listener


def _bind(listener: socket.socket, path: Path, group: int | None) -> None:
    before = os.umask(0o117)
    try:
        listener.bind(str(path))
    finally:
        os.umask(before)
    if group not in (None, path.stat().st_gid) and (os.geteuid() == 0 or group in os.getgroups()):
        os.chown(path, -1, group)
