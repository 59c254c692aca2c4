"""One client: its share of a round, its buffers, what it sent before it left, and who is let in when."""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest
from served import Echo

from servod.formats.config import ControlConfig
from servod.formats.protocol import Verb
from servod.runtime.daemon.connection import Connection
from servod.runtime.daemon.control_server import (
    _ACCEPT_IN_A_ROUND,
    ConnectedClients,
    ControlServer,
)
from tests.on_event_loop import events_pass, on_event_loop


class _Desk:
    """What a connection belongs to: notes the lines, and answers none."""

    def __init__(self) -> None:
        self.lines: list[bytes] = []
        self.unheard: list[bytes] = []
        self.dropped = 0

    def dispatch(self, _client: Connection, line: bytes) -> None:
        self.lines.append(line)

    def hear_out(self, _client: Connection, lines: list[bytes]) -> None:
        self.unheard = lines

    def drop(self, client: Connection) -> None:
        self.dropped += 1
        client.close()


@pytest.fixture
def wires() -> Iterator[tuple[socket.socket, socket.socket]]:
    """A client's end and the server's."""
    client, server = socket.socketpair()
    server.setblocking(False)
    with client, server:
        yield client, server


@on_event_loop
async def test_client_is_asked_four_times_in_each_round(wires: tuple[socket.socket, socket.socket]) -> None:
    (client, server), desk = wires, _Desk()
    client.send(b"0\n")
    connection = Connection(server, desk)
    connection.begin()
    assert desk.lines == [b"0"]  # what came with the connection is served before anybody else comes
    for number in range(1, 6):
        client.send(b"%d\n" % number)
        await events_pass()
    assert desk.lines == [b"0", b"1", b"2", b"3"]
    connection.begin_round(1)
    await events_pass()
    assert desk.lines == [b"0", b"1", b"2", b"3", b"4", b"5"]


@on_event_loop
async def test_client_that_is_dropped_leaves_nothing_on_the_event_loop(
    wires: tuple[socket.socket, socket.socket],
) -> None:
    """Before its task went its first step, while it waits for bytes, and while it waits for the next round."""
    (_, server), desk, own = wires, _Desk(), asyncio.current_task()
    connection = Connection(server, desk)
    connection.begin()
    connection.close()
    await events_pass()
    assert asyncio.all_tasks() == {own}
    for sent in (b"", b"x\n" * 9):
        client, server = socket.socketpair()
        server.setblocking(False)
        client.send(sent)
        connection = Connection(server, desk)
        connection.begin()
        await events_pass()
        client.close()
        connection.begin_round(1)
        await events_pass()
        assert asyncio.all_tasks() == {own}


@on_event_loop
async def test_client_is_read_four_times_in_each_round(wires: tuple[socket.socket, socket.socket]) -> None:
    """Single bytes, each of which would wake the daemon."""
    (client, server), desk = wires, _Desk()
    connection = Connection(server, desk)
    connection.begin()
    for _ in range(9):
        client.send(b"x")
        await events_pass()
    assert connection.held_bytes == 4
    connection.begin_round(1)
    await events_pass()
    assert connection.held_bytes == 9


@on_event_loop
async def test_client_is_asked_again_as_soon_as_it_has_read(wires: tuple[socket.socket, socket.socket]) -> None:
    (client, server), desk = wires, _Desk()
    connection = Connection(server, desk)
    connection.send({"long": "x" * 1_000_000})
    connection.begin()
    client.send(b"1\n")
    await events_pass()
    assert desk.lines == [] and connection.held_bytes > 64 * 1024
    client.setblocking(False)
    while connection.held_bytes:
        with contextlib.suppress(BlockingIOError):
            client.recv(1 << 20)
        await events_pass()
    await events_pass()
    assert desk.lines == [b"1"]


def _pair_with(number: int) -> tuple[socket.socket, socket.socket]:
    """Two connected sockets, the first with this number, which is free; lower ones may be, too."""
    ours, theirs = sorted(socket.socketpair(), key=lambda end: end.fileno() != number)
    if ours.fileno() != number:
        with ours:
            ours = socket.socket(fileno=fcntl.fcntl(ours, fcntl.F_DUPFD_CLOEXEC, number))
    return ours, theirs


@on_event_loop
async def test_newcomer_with_the_number_of_a_socket_just_closed_is_heard(
    wires: tuple[socket.socket, socket.socket],
) -> None:
    (_, server), desk, number = wires, _Desk(), wires[1].fileno()
    before = Connection(server, desk)
    before.begin()
    await events_pass()
    before.close()
    ours, theirs = _pair_with(number)
    assert ours.fileno() == number
    ours.setblocking(False)
    Connection(ours, desk).begin()
    for _ in range(2):
        await events_pass()
    theirs.send(b"stop\n")
    await events_pass()
    assert desk.lines == [b"stop"]
    theirs.close()


@on_event_loop
async def test_each_request_shows_the_loop_that_the_supervisor_lives(tmp_path: Path) -> None:
    fed: list[bool] = []
    server = ControlServer(ControlConfig(socket=tmp_path / "s"), Echo(), lambda: fed.append(True))
    server.begin()
    with socket.socket(socket.AF_UNIX) as client:
        client.connect(str(tmp_path / "s"))
        client.send(b'{"verb":"status"}\ngarbage\n')
        await events_pass()
    server.close()
    assert fed == [True, True]


@on_event_loop
async def test_door_that_broke_ends_the_supervisor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An axis that nobody could stop any more is not to run on."""
    monkeypatch.delattr(ConnectedClients, "make_room")
    server = ControlServer(ControlConfig(socket=tmp_path / "s"), Echo())
    server.begin()
    with socket.socket(socket.AF_UNIX) as client:
        client.connect(str(tmp_path / "s"))
        await events_pass()
    with pytest.raises(AttributeError, match="make_room"):
        server.tick(1)
    server.close()


@on_event_loop
async def test_who_asks_for_a_stop_and_hangs_up_is_heard(tmp_path: Path) -> None:
    """Behind more lines than a round has for one client; nothing else of them is begun once it has left."""
    echo = Echo()
    server = ControlServer(ControlConfig(socket=tmp_path / "s"), echo)
    server.begin()
    with socket.socket(socket.AF_UNIX) as client:
        client.connect(str(tmp_path / "s"))
        client.send(b'{"verb":"status"}\n' * 7 + b'{"verb":"enable"}\n{"verb":"stop"}\n{"verb":"stop"}\n')
        await events_pass()
    begun = len(echo.asked)
    server.tick(1)
    assert echo.asked[begun:] == [Verb.STOP]
    server.close()


@on_event_loop
async def test_mistake_in_serving_a_client_ends_that_client_alone_and_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Also with what came together with the connection, which is served as it is let in."""

    def mistaken(*_: object) -> bytes:
        raise KeyError("nobody foresaw this")

    echo = Echo()
    server = ControlServer(ControlConfig(socket=tmp_path / "s"), echo)
    with monkeypatch.context() as patch, socket.socket(socket.AF_UNIX) as client:
        patch.setattr(Connection, "_cut", mistaken)
        client.connect(str(tmp_path / "s"))
        client.send(b'{"verb":"stop"}\n')
        server.begin()
        await events_pass()
        assert client.recv(100) == b""
    assert "a client could not be served" in caplog.text and "nobody foresaw this" in caplog.text
    server.tick(1)
    with socket.socket(socket.AF_UNIX) as client:
        client.connect(str(tmp_path / "s"))
        client.send(b'{"verb":"stop"}\n')
        await events_pass()
        server.tick(2)
        await events_pass()
        assert echo.asked == [Verb.STOP]
    server.close()


@on_event_loop
async def test_a_batch_of_newcomers_that_spans_a_round_is_followed_by_a_pause(tmp_path: Path) -> None:
    server = ControlServer(ControlConfig(socket=tmp_path / "s"), Echo())
    taken: list[object] = []
    server._admit = taken.append  # type: ignore[method-assign]
    server.begin()
    await events_pass()
    server.tick(1)  # the batch has begun and nobody has come
    clients = [socket.socket(socket.AF_UNIX) for _ in range(_ACCEPT_IN_A_ROUND + 5)]
    for client in clients:
        client.connect(str(tmp_path / "s"))
        await events_pass()
    await asyncio.sleep(0.01)
    assert len(taken) == _ACCEPT_IN_A_ROUND
    server.tick(2)
    await asyncio.sleep(0.01)
    assert len(taken) == len(clients)
    for client in clients:
        client.close()
    server.close()
