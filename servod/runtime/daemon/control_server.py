"""Server side of the control socket: clients in, requests out, answers back, and never a moment of waiting.

Runs on the supervisor's event loop; sockets do not block. A client that is slow, broken or malicious loses its own
connection and nothing else: lines, buffers, requests under way and the number of clients are bounded, in all and for
each process, and so is what one round of the supervisor does for each client. Who may ask what:
servod.runtime.daemon.control_server.
Protocol: servod.client.control.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import logging
import os
import re
import socket
import stat
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

from servod.common.errors import BadInput, ServodError, Unreachable
from servod.common.files import reason
from servod.common.units import NS_PER_S
from servod.formats.config import ControlConfig
from servod.formats.protocol import MAX_LINE_BYTES, READING, Verb, decode_line, encode_line
from servod.runtime.daemon.connection import Connection, Reply
from servod.runtime.daemon.peer import Peer, group_id, may_command, peer_of
from servod.runtime.daemon.status import LeaseStatus

# --- The right to command --------------------------------------------------------------------------------------------
# Who may ask what: one client at a time commands, everyone in the group may look, and stop the axis. The first client
# that commands holds the lease until it disconnects. A stop needs no lease, and wins over whoever holds it: that client
# may not enable the axis again until it connects again. While a motion runs whose client has left, others can only end
# it.


#: Anyone who may command may bring the axis to rest, whoever holds the lease.
STOPPING = frozenset({Verb.STOP, Verb.DISABLE})
#: What others may ask while a motion runs whose client has left: to end it, and what does not touch the axis.
_BESIDE_MOTION = STOPPING | {Verb.HALT, Verb.RECORD_START, Verb.RECORD_STOP}


class Lease:
    """The right to command, and who gave it up, left a motion behind, or was stopped."""

    def __init__(self, motion_running: Callable[[], bool]) -> None:
        """`motion_running`: a motion runs, or is on its way to the loop."""
        self._motion_running = motion_running
        self.holder: Connection | None = None
        self._mover: Connection | None = None  # started the last motion
        self._stopped_by: Peer | None = None  # who stopped the holder's axis

    def status(self) -> LeaseStatus:
        """Who commands, and who stopped him; pid 0 when nobody does."""
        peer, stopper = self.holder.peer if self.holder else None, self._stopped_by
        return {
            "pid": peer.pid if peer else 0,
            "uid": peer.uid if peer else 0,
            "stopped_by": stopper.pid if stopper else 0,
        }

    def take(self, client: Connection, verb: Verb) -> None:
        """Check the right of `client` to ask for `verb`, and give it the lease where the verb needs it.

        Raises Unreachable with the process that stands in the way.
        """
        if verb in READING:
            return
        if verb in STOPPING:
            self._stop(client)
            return
        self._refuse_beside_holder(client)
        if verb is Verb.ENABLE and self._stopped_by is not None:
            stopper = self._stopped_by.pid
            raise Unreachable(f"process {stopper} stopped the axis; connect again before you enable it")
        if verb not in _BESIDE_MOTION:
            self._refuse_beside_motion(client)
        self.holder = client
        if verb is Verb.TRACK:
            self._mover = client

    def lets_go(self, limit_ns: int) -> str:
        """Why nobody holds the motion any more that its client is to renew each `limit_ns`; empty while it does.

        An open connection says nothing: a process that the client forked, or one that hangs, keeps it open.
        """
        if self._mover is None:
            return ""
        pid = self._mover.peer.pid
        if self._mover is not self.holder:
            return f"process {pid}, which started it, has left"
        if self._mover.unheard_ns > limit_ns:
            return f"process {pid}, which started it, has asked nothing for {limit_ns / NS_PER_S:g} s"
        return ""

    def left(self, client: Connection) -> bool:
        """A client has gone; whether it held the lease."""
        if self.holder is not client:
            return False
        self.holder = self._stopped_by = None
        return True

    def _stop(self, client: Connection) -> None:
        """A process may stop its own axis on a second connection, and go on."""
        if self.holder is not None and self.holder.peer.pid != client.peer.pid:
            self._stopped_by = client.peer

    def _refuse_beside_holder(self, client: Connection) -> None:
        if self.holder is not None and self.holder is not client:
            raise Unreachable(f"process {self.holder.peer.pid} commands the axis; others may watch, or stop it")

    def _refuse_beside_motion(self, client: Connection) -> None:
        if self._mover is not None and self._mover is not client and self._motion_running():
            started = f"a motion that process {self._mover.peer.pid} started runs"
            raise Unreachable(f"{started}; wait for its end, or stop, halt or disable the axis")


# --- Connections -----------------------------------------------------------------------------------------------------
# Who has a place at the control socket, and who gives way when all are taken. Whoever wants to stop the axis shall find
# a place, however many idle clients there are: no process has more than its share, and of a full house leaves who is
# idle, else one of the most crowded process. The one who commands stays; who commanded a moment ago, or stopped the
# axis, which takes no lease, leaves after all others.


MAX_CLIENTS = 32
MAX_CLIENTS_OF_A_PROCESS = 16
_IDLE_NS = 2 * NS_PER_S
#: Between two commands, a person looks at the machine.
_COMMANDED_NS = 60 * NS_PER_S


class ConnectedClients:
    """The clients that are connected."""

    def __init__(self) -> None:
        self.clients: set[Connection] = set()

    def take(self, client: Connection) -> None:
        """A new client, for which `make_room` found a place."""
        self.clients.add(client)

    def leave(self, client: Connection) -> None:
        """A client has gone."""
        self.clients.discard(client)

    def make_room(self, peer: Peer, holder: Connection | None, now_ns: int) -> Connection | None:
        """Who must leave for one more client of `peer`; None when there is room. Raises Unreachable: no place."""
        crowd = Counter(client.peer.pid for client in self.clients)
        full = crowd[peer.pid] >= MAX_CLIENTS_OF_A_PROCESS
        if not full and len(self.clients) < MAX_CLIENTS:
            return None
        others = [c for c in self.clients if c is not holder and (c.peer.pid == peer.pid or not full)]
        idle_since_ns = now_ns - _IDLE_NS

        def staying(c: Connection) -> tuple[bool, bool, bool, int, int]:
            """Who has least of it leaves."""
            commanded = c.commanded_ns is not None and c.commanded_ns > now_ns - _COMMANDED_NS
            return commanded, c.under_way > 0, c.active_ns > idle_since_ns, -crowd[c.peer.pid], c.active_ns

        leaves = min(others, key=staying)
        if leaves.active_ns > idle_since_ns and crowd[peer.pid] > crowd[leaves.peer.pid]:
            raise Unreachable(f"all places are taken, {crowd[peer.pid]} of them by process {peer.pid}")
        return leaves


log = logging.getLogger("servod.control")

_BACKLOG = 24
#: Connections taken in one round: whoever wants to stop the axis stands behind no longer a queue.
_ACCEPT_IN_A_ROUND = _BACKLOG
#: Requests without an answer yet, of one client and of all; a stop has room beyond them.
_UNDER_WAY_OF_A_CLIENT, _UNDER_WAY = 8, 64
_EXTRA_FOR_STOPS = 32
#: What is answered at once and never under way.
_AT_ONCE = frozenset({Verb.STATUS, Verb.TRAJECTORY})
_LONGEST_NUMBER = 64
_MAY_STOP = re.compile("|".join(STOPPING).encode())


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

    @property
    def renew_ns(self) -> int | None:
        """How long the motion that runs goes on without a word of its client; None: for good, or there is none."""
        ...

    def abandon_motion(self, why: str) -> None:
        """Bring the reference to rest, and end the motion there."""
        ...


class ControlServer:
    """The listening socket and its clients."""

    def __init__(self, config: ControlConfig, handler: Handler, feed: Callable[[], None] = lambda: None) -> None:
        """Bind and listen. Raises Unreachable when that is refused. The caller holds the instance lock.

        `feed` is called for each request: many clients at once are no sign of a supervisor that hangs.
        """
        self._path, self._handler, self._feed = config.socket, handler, feed
        self._group = group_id(config.group)
        self._connected = ConnectedClients()
        self._lease = Lease(handler.motion_running)
        self._under_way = self._now_ns = 0
        self._status_failed = False
        self._round = asyncio.Event()
        self._listener = _listen(config.socket, self._group)
        self._inode, self._look_ns, self._closed_reported = _inode_of(config.socket), 0, False
        self._welcoming: asyncio.Task[None] | None = None

    def begin(self) -> None:
        """Take clients from now on; call it on the event loop."""
        self._welcoming = asyncio.get_running_loop().create_task(self._welcome())

    def tick(self, now_ns: int) -> None:
        """A new round for every client, and what watchers are due; call it every 20 ms."""
        self._now_ns = now_ns
        if self._welcoming and self._welcoming.done():
            self._welcoming.result()  # a mistake of ours: without a door the axis is not to run on
        self._round.set()
        self._keep_door(now_ns)
        for client in list(self._connected.clients):
            client.begin_round(now_ns)
        if (limit_ns := self._handler.renew_ns) is not None and (why := self._lease.lets_go(limit_ns)):
            self._handler.abandon_motion(why)
        self._serve_watchers(now_ns)

    def _keep_door(self, now_ns: int) -> None:
        """A socket file that somebody removed is made again: who is connected stays, and newcomers must find it."""
        if now_ns < self._look_ns or self._welcoming is None:
            return
        self._look_ns = now_ns + NS_PER_S
        if _inode_of(self._path) == self._inode:
            return
        try:
            listener = _listen(self._path, self._group)
        except Unreachable as error:
            if not self._closed_reported:
                log.error("the control socket is gone, and newcomers cannot stop the axis: %s", error)
            self._closed_reported = True
            return
        log.warning("%s was gone and is made again", self._path)
        self._shut(taking_queue=True)
        self._listener, self._inode, self._closed_reported = listener, _inode_of(self._path), False
        self.begin()

    def _shut(self, taking_queue: bool = False) -> None:
        """Take no more clients at the present listener, but for those who queue there, if they are wanted."""
        if self._welcoming:
            self._welcoming.cancel()
            self._welcoming.get_loop().remove_reader(self._listener)
        self._welcoming = None
        if taking_queue:
            self._take_queued(_BACKLOG + 1)
        self._listener.close()

    def _serve_watchers(self, now_ns: int) -> None:
        due = [c for c in self._connected.clients if c.watch_due(now_ns)]
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
        return self._lease.status()

    @property
    def held_bytes(self) -> int:
        """Memory of all clients' buffers."""
        return sum(client.held_bytes for client in self._connected.clients)

    def close(self, why: str = "servod ends") -> None:
        """Hang up on everyone, with a line that says `why`, and remove the socket."""
        for client in list(self._connected.clients):
            Reply(client.send, None).failed(Unreachable(why))
            self.drop(client)
        self._shut()
        self._path.unlink(missing_ok=True)

    def drop(self, client: Connection) -> None:
        """Forget a client that has gone or must go; gives its lease back."""
        self._connected.leave(client)
        client.close()
        if self._lease.left(client):
            self._handler.lease_ended()

    async def _welcome(self) -> None:
        """Take those who queue, a few in each round.

        Waits for somebody to queue and takes him at once: `sock_accept`, cancelled, may have taken one and lose him.
        """
        loop, listener, slots_left = asyncio.get_running_loop(), self._listener, _ACCEPT_IN_A_ROUND
        while True:
            somebody = asyncio.Event()
            loop.add_reader(listener, somebody.set)
            await somebody.wait()
            loop.remove_reader(listener)
            taken = self._take_queued(slots_left)
            slots_left -= taken
            if not taken:
                self._round.clear()
                await self._round.wait()
                slots_left = _ACCEPT_IN_A_ROUND

    def _take_queued(self, most: int) -> int:
        """How many of those who queue found their way in."""
        for taken in range(most):
            try:
                connection, _address = self._listener.accept()
            except OSError:  # nobody any more; or descriptors ran out: nothing to hold against the axis
                return taken
            connection.setblocking(False)
            self._admit(connection)
        return most

    def _admit(self, connection: socket.socket) -> None:
        """A place for a new client, or one line that says why not; what it sent with its connection is served now."""
        peer = peer_of(connection)
        try:
            if not may_command(peer, self._group):
                raise Unreachable(f"user {peer.uid} may not connect: not in the control group")
            if leaves := self._connected.make_room(peer, self._lease.holder, self._now_ns):
                Reply(leaves.send, None).failed(Unreachable("idle for longest when others wanted its place"))
                self.drop(leaves)
        except Unreachable as error:
            with contextlib.suppress(OSError):
                Reply(lambda message: _send_once(connection, message), None).failed(error)
            connection.close()
            return
        client = Connection(connection, self, self._now_ns)
        self._connected.take(client)
        client.begin()

    def hear_out(self, client: Connection, lines: list[bytes]) -> None:
        """Who asks for a stop and hangs up is heard all the same; nothing else that it asked is begun any more."""
        for line in lines:
            if len(line) <= MAX_LINE_BYTES and _MAY_STOP.search(line):
                with contextlib.suppress(ServodError):
                    if decode_line(line).get("verb") in STOPPING:
                        self.dispatch(client, line)
                        return

    def dispatch(self, client: Connection, line: bytes) -> None:
        """One request line: check it, check the right to ask it, and hand it on."""
        self._feed()
        reply = Reply(client.send, None)
        try:
            message = decode_line(line)
            reply = Reply(client.send, _number(message))
            verb, args = _request(message)
            if (holder := self._lease.holder) is not None and holder is not client and holder.has_left():
                self.drop(holder)
            self._lease.take(client, verb)
            if verb not in READING:
                client.commanded_ns = self._now_ns
            if verb is Verb.WATCH:
                client.start_watch(args, reply)
                return
            reply = self._begin(client, verb, _number(message))
            self._handler.handle(verb, args, reply)
        except ServodError as error:
            reply.failed(error)
        except ValueError as error:
            reply.failed(BadInput("request", str(error)[:200], "one JSON object per line"))
        except Exception as error:  # one request ends, never the supervisor
            log.error("a request failed", exc_info=error)
            reply.failed(error)

    def _begin(self, client: Connection, verb: Verb, number: int | str | None) -> Reply:
        """The reply of a request that is now under way. Raises Unreachable when too many are."""
        if verb in _AT_ONCE:
            return Reply(client.send, number)
        extra = _EXTRA_FOR_STOPS if verb in STOPPING else 0
        if client.under_way >= _UNDER_WAY_OF_A_CLIENT + extra or self._under_way >= _UNDER_WAY + extra:
            raise Unreachable(f"{self._under_way} requests are under way; wait for their answers")
        client.under_way += 1
        self._under_way += 1

        def ended() -> None:
            client.under_way -= 1
            self._under_way -= 1

        return Reply(client.send, number, ended)


def _send_once(connection: socket.socket, message: dict[str, Any]) -> None:
    """One short line to somebody who gets no place; it fits into the empty buffer of a new connection."""
    connection.send(encode_line(message))


def _number(message: dict[str, Any]) -> int | str | None:
    """The request's number, which goes back with the answer. Raises BadInput for anything else."""
    number = message.get("id")
    if number is None or (isinstance(number, int | str) and len(str(number)) <= _LONGEST_NUMBER):
        return number
    raise BadInput(
        "request: id", repr(number)[:80], f"a whole number or a text of at most {_LONGEST_NUMBER} characters"
    )


def _request(message: dict[str, Any]) -> tuple[Verb, dict[str, Any]]:
    name, args = message.get("verb"), message.get("args", {})
    if not isinstance(args, dict):
        raise BadInput("request: args", type(args).__name__, "an object")
    try:
        return Verb(str(name)), args
    except ValueError:
        raise BadInput("request: verb", repr(name)[:80], ", ".join(Verb)) from None


def _inode_of(path: Path) -> tuple[int, int] | None:
    """What tells a file from another one of its name; None when there is none to be seen."""
    try:
        state = path.stat()
    except OSError:
        return None
    return state.st_dev, state.st_ino


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
        raise Unreachable(f"{path}: cannot listen there ({reason(error)})") from None
    return listener


def _bind(listener: socket.socket, path: Path, group: int | None) -> None:
    before = os.umask(0o117)
    try:
        listener.bind(str(path))
    finally:
        os.umask(before)
    if group not in (None, path.stat().st_gid) and (os.geteuid() == 0 or group in os.getgroups()):
        os.chown(path, -1, group)
