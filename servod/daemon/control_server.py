"""Server side of the control socket: clients in, requests out, answers back, and never a moment of waiting.

Runs inside the supervisor's event loop; sockets do not block. A client that is slow, broken or malicious loses its own
connection and nothing else: lines, buffers and the number of clients are bounded, in all and for each process. Only one
client at a time may command: the first that does holds the lease until it disconnects, and while a motion that it left
behind runs, others can only end it. Protocol: servod.control.
"""

from __future__ import annotations

import errno
import logging
import os
import selectors
import socket
import stat
from pathlib import Path
from typing import Any, Protocol

from servod.config import ControlConfig
from servod.control import READING, Verb, decode_line
from servod.daemon.connection import Connection, Reply
from servod.daemon.peer import Peer, group_id, may_command, peer_of
from servod.daemon.status import LeaseStatus
from servod.errors import BadInput, ServodError, Unreachable

log = logging.getLogger("servod.control")

_MAX_CLIENTS = 32
#: So that no single program can take all places from those who want to stop the axis.
_MAX_CLIENTS_OF_A_PROCESS = 16
_BACKLOG = 128
_ACCEPT_AT_ONCE = 16

#: Anyone who may command may stop the axis, whoever holds the lease.
_WITHOUT_LEASE = frozenset({Verb.STOP})
#: What others may ask while a motion runs whose client has left: to end it, and what does not touch the axis.
_BESIDE_MOTION = frozenset({Verb.STOP, Verb.DISABLE, Verb.HALT, Verb.RECORD_START, Verb.RECORD_STOP})


class Handler(Protocol):
    """What carries requests out; all methods return at once."""

    def handle(self, verb: Verb, args: dict[str, Any], reply: Reply) -> None:
        """Carry out one request; answers through `reply`, at once or later. May raise ServodError."""
        ...

    def status(self) -> dict[str, Any]:
        """The status document for watchers."""
        ...

    def motion_running(self) -> bool:
        """Whether a motion runs, or is on its way to the loop."""
        ...

    def lease_ended(self) -> None:
        """The commanding client has gone: what it began and did not finish is void."""
        ...


class ControlServer:
    """The listening socket and its clients."""

    def __init__(self, config: ControlConfig, selector: selectors.BaseSelector, handler: Handler) -> None:
        """Bind and listen. Raises Unreachable when that is refused. The caller holds the instance lock."""
        self._path, self._selector, self._handler = config.socket, selector, handler
        self._group = group_id(config.group)
        self._clients: set[Connection] = set()
        self._holder: Connection | None = None
        self._mover: Connection | None = None
        self._status_failed = False
        self._listener = _listen(config.socket, self._group)
        selector.register(self._listener, selectors.EVENT_READ, self._accept)

    def tick(self, now_ns: int) -> None:
        """Send watchers what is due; call it in every round of the event loop."""
        due = [c for c in self._clients if c.watch_due(now_ns)]
        if not due:
            return
        try:
            status = self._handler.status()
        except Exception as error:  # whatever is wrong with the status, the event loop goes on
            self._status_broke(due, error, now_ns)
        else:
            for client in due:
                client.send_watch(lambda reply: reply.done(status), now_ns)

    def _status_broke(self, due: list[Connection], error: Exception, now_ns: int) -> None:
        """Tell the watchers; an error that is none of ours is logged, once."""
        if not isinstance(error, ServodError) and not self._status_failed:
            self._status_failed = True
            log.error("the status cannot be made", exc_info=error)
        for client in due:
            client.send_watch(lambda reply: reply.failed(error), now_ns)

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

    def drop(self, client: Connection) -> None:
        """Forget a client that has gone or must go; gives its lease back."""
        if client in self._clients:
            self._clients.remove(client)
            client.close()
        if self._holder is client:
            self._holder = None
            self._handler.lease_ended()

    def _accept(self, _events: int) -> None:
        for _ in range(_ACCEPT_AT_ONCE):
            try:
                connection, _address = self._listener.accept()
            except OSError:
                return  # nobody waits, or descriptors ran out: nothing to hold against the axis
            if not self._has_place(peer_of(connection)):
                connection.close()
                continue
            connection.setblocking(False)
            self._clients.add(Connection(connection, self._selector, self))

    def _has_place(self, peer: Peer) -> bool:
        of_this_process = sum(c.peer.pid == peer.pid for c in self._clients)
        return len(self._clients) < _MAX_CLIENTS and of_this_process < _MAX_CLIENTS_OF_A_PROCESS

    def dispatch(self, client: Connection, line: bytes) -> None:
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
        except Exception as error:  # one request ends, never the supervisor
            log.error("a request failed", exc_info=error)
            Reply(client.send, number).failed(error)

    def _check_right(self, client: Connection, verb: Verb) -> None:
        if verb in READING:
            return
        if not may_command(client.peer, self._group):
            raise Unreachable(f"user {client.peer.uid} may not command this axis: not in the control group")
        if verb in _WITHOUT_LEASE:
            return
        if self._holder not in (None, client):
            assert self._holder is not None
            raise Unreachable(f"process {self._holder.peer.pid} commands the axis; others may watch, or stop it")
        if verb not in _BESIDE_MOTION:
            self._refuse_beside_motion(client)
        self._holder = client
        if verb is Verb.TRACK:
            self._mover = client

    def _refuse_beside_motion(self, client: Connection) -> None:
        if self._mover not in (None, client) and self._handler.motion_running():
            assert self._mover is not None
            started = f"a motion that process {self._mover.peer.pid} started runs"
            raise Unreachable(f"{started}; wait for its end, or stop, halt or disable the axis")


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
