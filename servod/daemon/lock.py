"""One daemon per control socket and per bus: locks that die with their process.

Taken by the supervisor before it touches either. Each lock is a listening socket in the abstract name space: it lives
exactly as long as the process, leaves no file behind, is seen in the network name space that CAN interfaces live in
as well, and tells by SO_PEERCRED who holds it.
"""

from __future__ import annotations

import hashlib
import socket

from servod.config import AxisConfig
from servod.daemon.peer import peer_of
from servod.errors import Unreachable


class InstanceLock:
    """The locks of one daemon; `release` or the end of the process gives them back."""

    def __init__(self, config: AxisConfig) -> None:
        """Raises Unreachable, naming the process that holds it, when either is taken."""
        self._sockets: list[socket.socket] = []
        try:
            self._take(f"control socket {config.control.socket.resolve()}")
            self._take(f"bus {config.bus.interface} {config.bus.channel}")
        except Unreachable:
            self.release()
            raise

    def _take(self, what: str) -> None:
        address = "\0servod-" + hashlib.sha256(what.encode()).hexdigest()[:32]
        lock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_CLOEXEC)
        try:
            lock.bind(address)
            lock.listen(1)
        except OSError:
            lock.close()
            raise Unreachable(f"{what}: another servod (process {_holder(address)}) owns it") from None
        self._sockets.append(lock)

    def release(self) -> None:
        """Give the locks back."""
        for lock in self._sockets:
            lock.close()
        self._sockets.clear()


def _holder(address: str) -> str:
    """Process id of the one that listens at `address`."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK) as probe:
        try:
            probe.connect(address)
            return str(peer_of(probe).pid)
        except OSError:
            return "unknown"
