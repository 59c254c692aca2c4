"""Who has a place at the control socket, and who gives way when all are taken.

Below the control server. Whoever wants to stop the axis shall find a place, however many idle clients there are: no
process has more than its share, and of a full house leaves who is idle, else one of the most crowded process. The one
who commands stays; who commanded a moment ago, or stopped the axis, which takes no lease, leaves after all others.
"""

from __future__ import annotations

from collections import Counter

from servod.common.errors import Unreachable
from servod.common.units import NS_PER_S
from servod.runtime.daemon.connection import Connection
from servod.runtime.daemon.peer import Peer

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
