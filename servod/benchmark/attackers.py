"""Clients that do everything wrong at once, as processes of their own: `python -m servod.benchmark.attackers SOCKET S`.

Beside the data path. They run at the lowest priority: what they take from the processor is not the control socket's
affair, what they make the daemon do is.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import sys
import time
from collections.abc import Callable, Iterator

#: 200 idle connections, from as many processes as could be two users' forgotten terminals.
_IDLE_PROCESSES, _IDLE_CONNECTIONS = 40, 5
_NICE = 19
_PAUSE_S = 0.01
_WATCH = b'{"id":1,"verb":"watch","args":{"period_s":0.02}}\n'
_ENDLESS_BYTES = 100_000_000
_REQUESTS = b'{"id":1,"verb":"status"}\n' * 500
_LEASELESS = b'{"id":1,"verb":"track","args":{"kind":"paper","duration_s":1}}\n' * 500
_NESTED = b"[" * 400_000 + b"\n"

#: Attacks one connection until the daemon hangs up, or time is over.
Attack = Callable[[socket.socket], None]


def _idle(connection: socket.socket) -> None:
    """Nothing, for ever."""
    connection.recv(1)


def _deaf(connection: socket.socket) -> None:
    """Watches, and never reads."""
    connection.sendall(_WATCH)
    time.sleep(1.0)


def _half(connection: socket.socket) -> None:
    """A request that never ends."""
    connection.sendall(b'{"id":1,"verb":"sta')
    connection.recv(1)


def _garbage(connection: socket.socket) -> None:
    """Bytes of no meaning, lines and pieces of lines."""
    connection.sendall(os.urandom(4096))


def _endless(connection: socket.socket) -> None:
    """A line of 100 MB."""
    piece = b"x" * 65_536
    for _ in range(_ENDLESS_BYTES // len(piece)):
        connection.sendall(piece)


def _deaf_flood(connection: socket.socket) -> None:
    """Requests whose answers nobody reads."""
    connection.sendall(_REQUESTS)


def _flood(connection: socket.socket) -> None:
    """Requests that are refused, as fast as the answers come."""
    connection.setblocking(False)
    while True:
        for act in (lambda: connection.send(_LEASELESS), lambda: connection.recv(65_536)):
            with contextlib.suppress(BlockingIOError):
                act()
        time.sleep(0.001)


def _nested(connection: socket.socket) -> None:
    """JSON too deep for any reader."""
    connection.sendall(_NESTED)
    connection.recv(4096)


def _blank(connection: socket.socket) -> None:
    """Single bytes, each of which wakes the daemon."""
    connection.send(b"\n")


def _come_and_go(connection: socket.socket) -> None:
    """Connections that say one thing and are gone."""
    connection.sendall(b'{"id":1,"verb":"gains_list"}\n')
    raise OSError


ATTACKS: tuple[Attack, ...] = (
    _deaf, _half, _garbage, _endless, _deaf_flood, _flood, _nested, _blank, _come_and_go,
)  # fmt: skip


def _again_and_again(path: str, attack: Attack, until_s: float) -> None:
    while time.monotonic() < until_s:
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX) as connection:
            connection.settimeout(1.0)
            connection.connect(path)
            while time.monotonic() < until_s:
                attack(connection)
        time.sleep(_PAUSE_S if attack is not _come_and_go else 0.0)


def _stay_idle(path: str, until_s: float) -> None:
    with contextlib.ExitStack() as stack:
        for _ in range(_IDLE_CONNECTIONS):
            connection = stack.enter_context(socket.socket(socket.AF_UNIX))
            connection.settimeout(1.0)
            with contextlib.suppress(OSError):
                connection.connect(path)
        time.sleep(max(0.0, until_s - time.monotonic()))


def _works(path: str, until_s: float) -> Iterator[Callable[[], None]]:
    for _ in range(_IDLE_PROCESSES):
        yield lambda: _stay_idle(path, until_s)
    for attack in ATTACKS:
        yield lambda attack=attack: _again_and_again(path, attack, until_s)  # type: ignore[misc]


def main(path: str, seconds: float) -> int:
    """Attack the socket at `path` for some time, every attack in a process of its own; all end with this one.

    The process that calls leads its process group (setsid(2)).
    """
    os.nice(_NICE)
    until_s = time.monotonic() + seconds
    for work in _works(path, until_s):
        if os.fork() == 0:
            work()
            os._exit(0)
    signal.signal(signal.SIGTERM, lambda *_: os.killpg(0, signal.SIGKILL))
    with contextlib.suppress(ChildProcessError):
        while True:
            os.wait()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], float(sys.argv[2])))
