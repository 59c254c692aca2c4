"""One client of the control socket: its two bounded buffers, its lines, and what it watches.

Below the control server.
"""

from __future__ import annotations

import selectors
import socket
from collections.abc import Callable
from typing import Any, Protocol

from servod.control import MAX_LINE_BYTES, encode_line
from servod.daemon.peer import Peer, peer_of
from servod.errors import BadInput, ServodError, Unreachable
from servod.units import NS_PER_S

_READ_BYTES = 65_536
_MAX_BACKLOG_BYTES = 4 * 1024 * 1024
_WATCH_BACKLOG_BYTES = 64 * 1024
_MIN_WATCH_S, _MAX_WATCH_S = 0.02, 60.0


class Reply:
    """The answer to one request, now or later; answering a client that has gone does nothing."""

    def __init__(self, send: Callable[[dict[str, Any]], None], number: Any) -> None:
        self._send, self._number = send, number

    def done(self, result: dict[str, Any]) -> None:
        """The request was carried out."""
        self._send({"id": self._number, "ok": True, "result": result})

    def failed(self, error: Exception) -> None:
        """The request was refused; one line and the exit code for the command line."""
        known = error if isinstance(error, ServodError) else Unreachable(f"servod failed at this: {error!r}"[:300])
        answer = {"exit_code": known.exit_code, "message": " ".join(str(known).split())}
        self._send({"id": self._number, "ok": False, "error": answer})


class Owner(Protocol):
    """What a connection belongs to."""

    def dispatch(self, client: Connection, line: bytes) -> None:
        """One request line came."""
        ...

    def drop(self, client: Connection) -> None:
        """The client has gone, or must go."""
        ...


class Connection:
    """One connection with its two buffers."""

    def __init__(self, connection: socket.socket, selector: selectors.BaseSelector, owner: Owner) -> None:
        self.peer: Peer = peer_of(connection)
        self._connection, self._selector, self._owner = connection, selector, owner
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
            self._owner.drop(self)
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
            if len(line) > MAX_LINE_BYTES:
                self._refuse_long_line()
                return
            if line.strip() and self._connection.fileno() >= 0:
                self._owner.dispatch(self, line)
        del self._incoming[:start]
        if len(self._incoming) > MAX_LINE_BYTES:
            self._refuse_long_line()

    def _refuse_long_line(self) -> None:
        Reply(self.send, None).failed(BadInput("request", "a longer line", f"at most {MAX_LINE_BYTES} bytes"))
        self._owner.drop(self)

    def send(self, message: dict[str, Any]) -> None:
        """Queue one line; a client that does not read its answers is dropped."""
        self._outgoing += encode_line(message)
        self._flush()
        if len(self._outgoing) > _MAX_BACKLOG_BYTES:
            self._owner.drop(self)

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

    def send_watch(self, answer: Callable[[Reply], None], now_ns: int) -> None:
        """One line for a watcher."""
        if self._watch_reply is not None:
            self._watch_next_ns = now_ns + self._watch_period_ns
            answer(self._watch_reply)

    def close(self) -> None:
        """Hang up."""
        self._selector.unregister(self._connection)
        self._connection.close()
