"""Who may ask what: one client at a time commands, everyone in the group may look, and stop the axis.

Below the control server. The first client that commands holds the lease until it disconnects. A stop needs no lease,
and wins over whoever holds it: that client may not enable the axis again until it connects anew. While a motion runs
whose client has left, others can only end it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

from servod.common.errors import Unreachable
from servod.common.units import NS_PER_S
from servod.formats.protocol import READING, Verb
from servod.runtime.daemon.connection import Connection
from servod.runtime.daemon.peer import Peer
from servod.runtime.daemon.status import LeaseStatus

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
        """Who commands; pid 0 when nobody does."""
        peer = self.holder.peer if self.holder else None
        return {"pid": peer.pid if peer else 0, "uid": peer.uid if peer else 0}

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
            raise Unreachable(f"process {stopper} stopped the axis; connect anew to enable it again")
        if verb not in _BESIDE_MOTION:
            self._refuse_beside_motion(client)
        self.holder = client
        if verb is Verb.TRACK:
            self._mover = client

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


# Who has a place at the control socket, and who gives way when all are taken.
#
# Below the control server. Whoever wants to stop the axis shall find a place, however many idle clients there are: no
# process has more than its share, and of a full house leaves who is idle, else one of the most crowded process. The one
# who commands stays; who commanded a moment ago, or stopped the axis, which takes no lease, leaves after all others.


MAX_CLIENTS = 32
MAX_CLIENTS_OF_A_PROCESS = 16
_IDLE_NS = 2 * NS_PER_S
#: Between two commands, a person looks at the machine.
_COMMANDED_NS = 60 * NS_PER_S


class Places:
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
