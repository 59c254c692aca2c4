"""One client of the control socket: its two bounded buffers, its share of the supervisor's time, and what it watches.

Below the control server. A client is served a few lines in each round, and none while it does not read its answers:
what it sends beyond that waits in the kernel, at its own expense.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import re
import select
import socket
from collections.abc import Callable
from typing import Any, Protocol

from servod.common.errors import BadInput, ServodError, Unreachable, details
from servod.common.units import NS_PER_S
from servod.formats.protocol import MAX_LINE_BYTES, encode_line
from servod.runtime.daemon.eager import begin
from servod.runtime.daemon.peer import Peer, peer_of

log = logging.getLogger("servod.control")

_READ_BYTES = 65_536
#: Reads and lines of one client in one round of the supervisor.
_READS_IN_A_ROUND = _LINES_IN_A_ROUND = 4
#: A client with so many answers unread is asked nothing and told nothing until it reads.
_UNREAD_BYTES = 64 * 1024
_MAX_BACKLOG_BYTES = 4 * 1024 * 1024
_MIN_WATCH_S, _MAX_WATCH_S = 0.02, 60.0
#: A round of the supervisor that takes longer was held up.
_LONGEST_ROUND_NS = NS_PER_S // 20
_BLANK = re.compile(rb"\s*")
_TOO_LONG = BadInput("request", "a longer line", f"at most {MAX_LINE_BYTES} bytes")


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

    def hear_out(self, client: Connection, lines: list[bytes]) -> None:
        """The client has left; what it sent before and was not served yet."""
        ...

    def drop(self, client: Connection) -> None:
        """The client has gone, or must go."""
        ...


class Connection:
    """One connection with its two buffers."""

    def __init__(self, connection: socket.socket, owner: Owner, now_ns: int = 0) -> None:
        """`connection` does not block; `now_ns` is when it came."""
        self.peer: Peer = peer_of(connection)
        self.active_ns = now_ns  # when it last asked something, or read what it watches
        self.commanded_ns: int | None = None  # when it last commanded, or stopped the axis
        self.unheard_ns = 0  # for how long it has asked nothing, without what held it or the supervisor up
        self.under_way = 0  # requests without an answer yet
        self._connection, self._owner, self._loop = connection, owner, asyncio.get_running_loop()
        self._incoming, self._outgoing = bytearray(), bytearray()
        self._searched = 0  # of the incoming bytes: no end of a line before here
        self._reads, self._lines, self._now_ns = _READS_IN_A_ROUND, _LINES_IN_A_ROUND, now_ns
        self._may_go_on = asyncio.Event()
        self._watch_period_ns, self._watch_next_ns = 0, 0
        self._watch_reply: Reply | None = None
        self._hung_up = select.poll()  # tells POLLHUP whatever it is asked for
        self._hung_up.register(connection, 0)
        self._serving: asyncio.Task[None] | None = None

    def begin(self) -> None:
        """Serve the client from now on; what it sent with its connection at once."""
        self._serving = begin(self._serve())

    @property
    def held_bytes(self) -> int:
        """Memory of both buffers."""
        return len(self._incoming) + len(self._outgoing)

    def begin_round(self, now_ns: int) -> None:
        """A new round: the client may be read again, and lines that waited are served; who has left is forgotten."""
        if self.has_left():
            self._owner.hear_out(self, self._rest())
            self._owner.drop(self)
            return
        self.unheard_ns = 0 if self.under_way else self.unheard_ns + min(now_ns - self._now_ns, _LONGEST_ROUND_NS)
        self._reads, self._lines, self._now_ns = _READS_IN_A_ROUND, _LINES_IN_A_ROUND, now_ns
        self._may_go_on.set()

    def has_left(self) -> bool:
        """The other end is closed, both ways, whatever of what it sent is still to be read."""
        return bool(self._hung_up.poll(0))

    def _rest(self) -> list[bytes]:
        """The whole lines that came and were not served."""
        with contextlib.suppress(OSError):
            for _ in range(_READS_IN_A_ROUND):
                self._incoming += self._connection.recv(_READ_BYTES)
        return bytes(self._incoming).split(b"\n")[:-1]

    async def _serve(self) -> None:
        """Dispatch line after line until the client leaves; a line without end must not fill the memory."""
        try:
            while data := await self._receive():
                self._incoming += data
                while 0 <= (end := self._line_end()) <= MAX_LINE_BYTES:
                    await self._share(lambda: self._lines)
                    self._lines -= 1
                    self.active_ns, self.unheard_ns = self._now_ns, 0
                    self._owner.dispatch(self, self._cut(end))
                if len(self._incoming) > MAX_LINE_BYTES:
                    Reply(self.send, None).failed(_TOO_LONG)
                    return
        except Exception as error:  # what nobody foresaw ends this client, and nothing else
            log.error("a client could not be served", exc_info=error)
        finally:
            self._owner.drop(self)

    async def _receive(self) -> bytes:
        """What came; nothing when the client has gone."""
        await self._share(lambda: min(self._reads, self._lines))
        self._reads -= 1
        try:
            return await self._loop.sock_recv(self._connection, _READ_BYTES)
        except OSError:
            return b""

    async def _share(self, left: Callable[[], int]) -> None:
        """Wait until something is left of the client's share of the round, and there is room for its answers."""
        while self._open and not (left() and len(self._outgoing) < _UNREAD_BYTES):
            self._may_go_on.clear()
            await self._may_go_on.wait()

    def _line_end(self) -> int:
        """Where the next line ends that is not blank, -1 when it is not complete; no byte is searched twice."""
        if blank := _BLANK.match(self._incoming):
            del self._incoming[: blank.end()]
            self._searched = max(0, self._searched - blank.end())
        end = self._incoming.find(b"\n", self._searched)
        self._searched = len(self._incoming) if end < 0 else end
        return end

    def _cut(self, end: int) -> bytes:
        line = bytes(self._incoming[:end])
        del self._incoming[: end + 1]
        self._searched = 0
        return line

    def send(self, message: dict[str, Any]) -> None:
        """Queue one line; raises ValueError, TypeError or RecursionError for what JSON cannot hold."""
        self._outgoing += encode_line(message)
        self._flush()
        if len(self._outgoing) > _MAX_BACKLOG_BYTES:
            self._owner.drop(self)

    def _flush(self) -> None:
        try:
            sent = self._connection.send(self._outgoing)
        except BlockingIOError:
            sent = 0
        except OSError:
            sent = len(self._outgoing)  # the read side sees the end and drops the client
        del self._outgoing[:sent]
        if self._outgoing:
            self._loop.add_writer(self._connection, self._flush)
        elif self._open:
            self._loop.remove_writer(self._connection)
        self._may_go_on.set()

    @property
    def _open(self) -> bool:
        return self._connection.fileno() >= 0

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
        if self._open:
            self._loop.remove_reader(self._connection)  # before its number is somebody else's
            self._loop.remove_writer(self._connection)
            self._connection.close()
        if self._serving:
            self._serving.cancel()
        self._incoming.clear()
        self._outgoing.clear()
