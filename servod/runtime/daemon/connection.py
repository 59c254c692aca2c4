"""One client of the control socket: its two bounded buffers, its share of the supervisor's time, and what it watches.

Below the control server. A client is served a few lines in each round, and none while it does not read its answers:
what it sends beyond that waits in the kernel, at its own expense.
"""

from __future__ import annotations

import re
import select
import selectors
import socket
from collections.abc import Callable
from typing import Any, Protocol

from servod.common.errors import BadInput, ServodError, Unreachable, details
from servod.common.units import NS_PER_S
from servod.formats.protocol import MAX_LINE_BYTES, encode_line
from servod.runtime.daemon.peer import Peer, peer_of

_READ_BYTES = 65_536
#: Reads and lines of one client in one round of the supervisor.
_READS_IN_A_ROUND = _LINES_IN_A_ROUND = 4
#: A client with so many answers unread is asked nothing and told nothing until it reads.
_UNREAD_BYTES = 64 * 1024
_MAX_BACKLOG_BYTES = 4 * 1024 * 1024
_MIN_WATCH_S, _MAX_WATCH_S = 0.02, 60.0
_BLANK = re.compile(rb"\s*")


class Reply:
    """The answer to one request, now or later; answering a client that has gone does nothing."""

    def __init__(
        self, send: Callable[[dict[str, Any]], None], number: Any, ended: Callable[[], None] | None = None
    ) -> None:
        """`ended` is told once, with the first answer."""
        self._send_line, self._number, self._ended = send, number, ended

    def _send(self, answer: dict[str, Any]) -> None:
        ended, self._ended = self._ended, None
        if ended is not None:
            ended()
        self._send_line(answer)

    def done(self, result: dict[str, Any]) -> None:
        """The request was carried out."""
        try:
            self._send({"id": self._number, "ok": True, "result": result})
        except (ValueError, TypeError, RecursionError) as error:  # nothing of it was sent
            self.failed(Unreachable(f"the answer cannot be told as JSON: {error}"))

    def failed(self, error: Exception) -> None:
        """The request was refused; one line and the exit code for the command line."""
        known = error if isinstance(error, ServodError) else Unreachable(f"servod failed at this: {error!r}"[:300])
        message = " ".join(str(known).split())
        answer = {"exit_code": known.exit_code, "message": message, **details(known)._asdict()}
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

    def __init__(
        self, connection: socket.socket, selector: selectors.BaseSelector, owner: Owner, now_ns: int = 0
    ) -> None:
        """`connection` does not block; `now_ns` is when it came."""
        self.peer: Peer = peer_of(connection)
        self.active_ns = now_ns  # when it last asked something, or read what it watches
        self.commanded_ns: int | None = None  # when it last commanded, or stopped the axis
        self.under_way = 0  # requests without an answer yet
        self._connection, self._selector, self._owner = connection, selector, owner
        self._incoming, self._outgoing = bytearray(), bytearray()
        self._searched = 0  # of the incoming bytes: no end of a line before here
        self._reads, self._lines, self._now_ns = _READS_IN_A_ROUND, _LINES_IN_A_ROUND, now_ns
        self._events = 0
        self._watch_period_ns, self._watch_next_ns = 0, 0
        self._watch_reply: Reply | None = None
        self._hung_up = select.poll()  # tells POLLHUP whatever it is asked for
        self._hung_up.register(connection, 0)
        self._want()

    @property
    def held_bytes(self) -> int:
        """Memory of both buffers."""
        return len(self._incoming) + len(self._outgoing)

    def begin_round(self, now_ns: int) -> None:
        """A new round: the client may be read again, and lines that waited are served; who has left is forgotten."""
        if self.has_left():
            self._owner.drop(self)
            return
        self._reads, self._lines, self._now_ns = _READS_IN_A_ROUND, _LINES_IN_A_ROUND, now_ns
        self._serve()

    def has_left(self) -> bool:
        """The other end is closed, both ways, whatever of what it sent is still to be read."""
        return bool(self._hung_up.poll(0))

    def read(self) -> None:
        """Take what came, and serve the lines in it."""
        if not self._reads or not self._open:
            return
        self._reads -= 1
        try:
            data = self._connection.recv(_READ_BYTES)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._owner.drop(self)
            return
        self._incoming += data
        self._serve()

    @property
    def _open(self) -> bool:
        return self._connection.fileno() >= 0

    def _on_events(self, events: int) -> None:
        if events & selectors.EVENT_WRITE:
            self._flush()
        if events & selectors.EVENT_READ:
            self.read()
        self._want()

    def _serve(self) -> None:
        """Dispatch complete lines, as many as this round has left; a line without end must not fill the memory."""
        while self._open and self._lines and len(self._outgoing) < _UNREAD_BYTES and (line := self._next_line()):
            if len(line) > MAX_LINE_BYTES:
                self._refuse_long_line()
                return
            self._lines -= 1
            self.active_ns = self._now_ns
            self._owner.dispatch(self, line)
        if not self._has_line() and len(self._incoming) > MAX_LINE_BYTES:
            self._refuse_long_line()
        self._want()

    def _has_line(self) -> bool:
        """Whether a complete line waits; bytes that were searched once are not searched again."""
        found = self._incoming.find(b"\n", self._searched) >= 0
        self._searched = self._searched if found else len(self._incoming)
        return found

    def _next_line(self) -> bytes:
        """Cut off the next line that is not blank; empty when there is none."""
        if blank := _BLANK.match(self._incoming):
            del self._incoming[: blank.end()]
            self._searched = max(0, self._searched - blank.end())
        if not self._has_line():
            return b""
        end = self._incoming.find(b"\n", self._searched)
        line = bytes(self._incoming[:end])
        del self._incoming[: end + 1]
        self._searched = 0
        return line

    def _refuse_long_line(self) -> None:
        if self._open:
            Reply(self.send, None).failed(BadInput("request", "a longer line", f"at most {MAX_LINE_BYTES} bytes"))
        self._owner.drop(self)

    def send(self, message: dict[str, Any]) -> None:
        """Queue one line; raises ValueError, TypeError or RecursionError for what JSON cannot hold."""
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
            self._outgoing.clear()  # the read side sees the end and drops the client
            sent = 0
        del self._outgoing[:sent]
        self._want()

    def _want(self) -> None:
        """Hear of bytes to read only while there is a share of the round left for them, and room for the answers."""
        if not self._open:
            return
        hears = self._reads and self._lines and len(self._outgoing) < _UNREAD_BYTES
        events = (selectors.EVENT_READ if hears else 0) | (selectors.EVENT_WRITE if self._outgoing else 0)
        if events == self._events:
            return
        if not events:
            self._selector.unregister(self._connection)
        elif self._events:
            self._selector.modify(self._connection, events, self._on_events)
        else:
            self._selector.register(self._connection, events, self._on_events)
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
        return self._watch_reply is not None and now_ns >= self._watch_next_ns and len(self._outgoing) < _UNREAD_BYTES

    def send_watch(self, answer: Callable[[Reply], None], now_ns: int) -> None:
        """One line for a watcher."""
        if self._watch_reply is not None:
            self._watch_next_ns = now_ns + self._watch_period_ns
            if not self._outgoing:
                self.active_ns = now_ns
            answer(self._watch_reply)

    def close(self) -> None:
        """Hang up."""
        if self._events:
            self._selector.unregister(self._connection)
            self._events = 0
        self._connection.close()
        self._incoming.clear()
        self._outgoing.clear()
