"""One daemon per control socket and per bus: locks that die with their process.

Taken by the supervisor before it touches either, and by whoever else wants the bus for itself. Each lock is a
listening socket in the abstract name space: it lives exactly as long as the process, leaves no file behind, is seen in
the network name space that CAN interfaces live in as well, and tells by SO_PEERCRED who holds it.
"""

from __future__ import annotations

import hashlib
import socket
from types import TracebackType
from typing import Self

from servod.common.errors import Unreachable
from servod.formats.config import AxisConfig, BusConfig
from servod.runtime.daemon.peer import peer_of


class _Lock:
    """Locks of one process; `release`, the end of a `with` block or of the process gives them back."""

    def __init__(self, *names: str) -> None:
        """Raises Unreachable, naming the process that holds it, when one of them is taken."""
        self._sockets: list[socket.socket] = []
        try:
            for name in names:
                self._take(name)
        except Unreachable:
            self.release()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.release()

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


class InstanceLock(_Lock):
    """What a daemon owns: its control socket and its bus."""

    def __init__(self, config: AxisConfig) -> None:
        super().__init__(f"control socket {config.control.socket.resolve()}", _bus_name(config.bus))


class BusLock(_Lock):
    """The bus alone, for a program that uses it for a moment."""

    def __init__(self, bus: BusConfig) -> None:
        super().__init__(_bus_name(bus))


def _bus_name(bus: BusConfig) -> str:
    return f"bus {bus.interface} {bus.channel}"


def _holder(address: str) -> str:
    """Process id of the one that listens at `address`."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK) as probe:
        try:
            probe.connect(address)
            return str(peer_of(probe).pid)
        except OSError:
            return "unknown"
