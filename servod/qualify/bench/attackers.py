"""Clients that do everything wrong at once, as processes of their own: `python -m servod.qualify.bench.attackers
SOCKET S`.

Beside the data path. They run at the lowest priority: what they take from the processor is not the control socket's
affair, what they make the daemon do is. At the end they tell in one line of JSON what became of each attack: an attack
that never got through proves nothing.
"""

from __future__ import annotations

import contextlib
import json
import mmap
import os
import signal
import socket
import sys
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

#: 200 idle connections, from as many processes as could be two users' forgotten terminals.
_IDLE_PROCESSES, _IDLE_CONNECTIONS = 40, 5
_NICE = 19
_PAUSE_S, _TIMEOUT_S = 0.01, 1.0
_WATCH = b'{"id":1,"verb":"watch","args":{"period_s":0.02}}\n'
_ENDLESS_BYTES = 100_000_000
_REQUESTS = b'{"id":1,"verb":"status"}\n' * 500
_LEASELESS = b'{"id":1,"verb":"track","args":{"kind":"paper","duration_s":1}}\n' * 500
_NESTED = b"[" * 400_000 + b"\n"


class AttackTally(NamedTuple):
    """What one kind of attack did."""

    connections: int
    bytes: int


class _Connection(socket.socket):
    """A connection to the daemon that counts itself and what the kernel took of its bytes."""

    def __init__(self, counts: memoryview) -> None:
        """`counts` holds this process's connections and bytes."""
        super().__init__(socket.AF_UNIX)
        self._counts = counts
        self.settimeout(_TIMEOUT_S)

    def join(self, path: str) -> None:
        """Connect. Raises OSError."""
        self.connect(path)
        self._counts[0] += 1

    def put(self, data: bytes) -> None:
        """Send all of it. Raises OSError when the daemon hangs up, or does not read."""
        rest = memoryview(data)
        while rest:
            rest = rest[self.put_some(rest) :]

    def put_some(self, data: bytes | memoryview) -> int:
        """Send as much as the kernel takes; how many bytes."""
        sent = self.send(data)
        self._counts[1] += sent
        return sent


#: Attacks one connection until the daemon hangs up, or time is over.
Attack = Callable[[_Connection], None]


def _idle(connection: _Connection) -> None:
    """Nothing, for ever; several in one process, see _stay_idle."""
    connection.recv(1)


def _deaf(connection: _Connection) -> None:
    """Watches, and never reads."""
    connection.put(_WATCH)
    time.sleep(1.0)


def _half(connection: _Connection) -> None:
    """A request that never ends."""
    connection.put(b'{"id":1,"verb":"sta')
    connection.recv(1)


def _garbage(connection: _Connection) -> None:
    """Bytes of no meaning, lines and pieces of lines."""
    connection.put(os.urandom(4096))


def _endless(connection: _Connection) -> None:
    """A line of 100 MB."""
    piece = b"x" * 65_536
    for _ in range(_ENDLESS_BYTES // len(piece)):
        connection.put(piece)


def _deaf_flood(connection: _Connection) -> None:
    """Requests whose answers nobody reads."""
    connection.put(_REQUESTS)


def _flood(connection: _Connection) -> None:
    """Requests that are refused, as fast as the answers come."""
    connection.setblocking(False)
    while True:
        for act in (lambda: connection.put_some(_LEASELESS), lambda: connection.recv(65_536)):
            with contextlib.suppress(BlockingIOError):
                act()
        time.sleep(0.001)


def _nested(connection: _Connection) -> None:
    """JSON too deep for any reader."""
    connection.put(_NESTED)
    connection.recv(4096)


def _blank(connection: _Connection) -> None:
    """Single bytes, each of which wakes the daemon."""
    connection.put(b"\n")


def _come_and_go(connection: _Connection) -> None:
    """Connections that say one thing and are gone."""
    connection.put(b'{"id":1,"verb":"gains_list"}\n')
    raise OSError


ATTACKS: tuple[Attack, ...] = (
    _deaf, _half, _garbage, _endless, _deaf_flood, _flood, _nested, _blank, _come_and_go,
)  # fmt: skip


def _again_and_again(path: str, attack: Attack, until_s: float, counts: memoryview) -> None:
    while time.monotonic() < until_s:
        with (
            contextlib.suppress(OSError),
            _Connection(counts) as connection,
        ):  # hung up on: that is the daemon's defence
            connection.join(path)
            while time.monotonic() < until_s:
                attack(connection)
        time.sleep(_PAUSE_S if attack is not _come_and_go else 0.0)


def _stay_idle(path: str, until_s: float, counts: memoryview) -> None:
    with contextlib.ExitStack() as stack:
        for _ in range(_IDLE_CONNECTIONS):
            _join_when_free(stack.enter_context(_Connection(counts)), path, until_s)
        time.sleep(max(0.0, until_s - time.monotonic()))


def _join_when_free(connection: _Connection, path: str, until_s: float) -> None:
    """The others stand in the same queue, and it may be full."""
    while time.monotonic() < until_s:
        try:
            connection.join(path)
            return
        except OSError:
            time.sleep(_PAUSE_S)


#: One entry for each process.
_WORKS: tuple[Attack, ...] = (_idle,) * _IDLE_PROCESSES + ATTACKS
#: What says nothing by its nature.
SILENT = frozenset({"idle"})
#: Said when every attack has begun.
AT_WORK = "all attacks are under way"


def kind(attack: Attack) -> str:
    """Its name for people."""
    return attack.__name__.strip("_")


def failed(tallies: Mapping[str, AttackTally]) -> list[str]:
    """The kinds of attack that never took place: no connection, or nothing said on it."""
    kinds = dict.fromkeys(map(kind, _WORKS))
    found = {name: tallies.get(name, AttackTally(0, 0)) for name in kinds}
    return [name for name, did in found.items() if not did.connections or not (did.bytes or name in SILENT)]


def _start(path: str, until_s: float, shared: memoryview) -> list[int]:
    """A process for each work, which writes its two numbers into its own place; their process ids."""
    pids = []
    for number, attack in enumerate(_WORKS):
        if (pid := os.fork()) == 0:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
            counts = shared[2 * number : 2 * number + 2]
            if attack is _idle:
                _stay_idle(path, until_s, counts)
            else:
                _again_and_again(path, attack, until_s, counts)
            os._exit(0)
        pids.append(pid)
    return pids


def _all_at_work(shared: memoryview) -> bool:
    """Every connection that is to idle is there, and every other attack has begun."""
    wanted = (_IDLE_CONNECTIONS if attack is _idle else 1 for attack in _WORKS)
    return all(made >= least for made, least in zip(shared[::2].tolist(), wanted, strict=True))


def _none_has_ended() -> bool:
    return os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None


def _summed(numbers: Sequence[int]) -> dict[str, AttackTally]:
    connections, sent = Counter[str](), Counter[str]()
    for number, attack in enumerate(_WORKS):
        connections[kind(attack)] += numbers[2 * number]
        sent[kind(attack)] += numbers[2 * number + 1]
    return {name: AttackTally(count, sent[name]) for name, count in connections.items()}


def main(path: str, seconds: float) -> int:
    """Attack the socket at `path` for some time or until SIGTERM, every attack in a process of its own.

    Prints AT_WORK when all have begun, and at the end what each kind did; 1 where one did not take place.
    """
    os.nice(_NICE)
    shared = memoryview(mmap.mmap(-1, 16 * len(_WORKS))).cast("Q")  # anonymous: the processes write what this one reads
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})  # until it is known whom to end
    pids = _start(path, time.monotonic() + seconds, shared)
    signal.signal(signal.SIGTERM, lambda *_: _end(pids))
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
    while _none_has_ended() and not _all_at_work(shared):
        time.sleep(_PAUSE_S)
    if _all_at_work(shared):
        print(AT_WORK, flush=True)
    with contextlib.suppress(ChildProcessError):
        while True:
            pids.remove(os.wait()[0])
    tallies = _summed(shared.tolist())
    print(json.dumps({name: did._asdict() for name, did in tallies.items()}), flush=True)
    return 1 if failed(tallies) else 0


def _end(pids: Sequence[int]) -> None:
    """All that have not been waited for: until then, their numbers belong to nobody else."""
    for pid in pids:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], float(sys.argv[2])))
