"""Who gets a place at the control socket, who is served when, and who wins: strangers, crowds, floods and stops."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import subprocess
import sys
import textwrap
import time
from collections.abc import Iterator
from pathlib import Path
from typing import cast

import pytest
from served import Served, answer_of, raw

from servod.client.control import ControlClient, Refused
from servod.common.errors import Unreachable
from servod.formats.protocol import Verb
from servod.runtime.daemon.connection import Connection
from servod.runtime.daemon.control_server import (
    MAX_CLIENTS,
    MAX_CLIENTS_OF_A_PROCESS,
    ConnectedClients,
)
from servod.runtime.daemon.peer import Peer


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Served]:
    served = Served(tmp_path / "axis.sock")
    yield served
    served.close()


def other_process(served: Served, code: str, user: int | None = None) -> subprocess.CompletedProcess[str]:
    """Run `code` with a connected `client` in a process of its own, as `user` of no group where that is given."""
    program = "import os\nfrom servod.client.control import ControlClient\n"
    if user is not None:
        program += f"os.setgroups([]); os.setgid({user}); os.setuid({user})\n"
    program += f"with ControlClient({str(served.path)!r}, 5.0) as client:\n" + textwrap.indent(code, "    ")
    return subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=20)


if os.geteuid() == 0:  # only root can be somebody else

    def test_stranger_is_kept_out_by_the_mode_of_the_file(served: Served) -> None:
        _open_folders(served.path)
        done = other_process(served, "client.call('status')", user=54321)
        assert "permission denied; only members of the control group" in done.stderr

    @pytest.mark.parametrize("verb", [Verb.STATUS, Verb.ENABLE, Verb.STOP])
    def test_stranger_is_refused_by_what_the_kernel_tells_of_him(served: Served, verb: Verb) -> None:
        """Somebody made the file's mode wider."""
        _open_folders(served.path)
        served.path.chmod(0o666)
        done = other_process(served, f"client.call({str(verb)!r})", user=54321)
        assert "user 54321 may not connect: not in the control group" in done.stderr
        assert served.handler.late == []

    def _open_folders(path: Path) -> None:
        """A temporary folder is for its owner only."""
        for folder in path.parents[:-2]:
            folder.chmod(0o755)


class _Guest:
    """As much of a connection as a place needs."""

    def __init__(self, pid: int, active_ns: int = 0, under_way: int = 0, commanded_ns: int | None = None) -> None:
        self.peer, self.active_ns, self.under_way = Peer(pid, 0, frozenset()), active_ns, under_way
        self.commanded_ns = commanded_ns


def _full(*guests: _Guest) -> ConnectedClients:
    slots = ConnectedClients()
    for guest in guests:
        slots.take(cast(Connection, guest))
    return slots


def _leaves(slots: ConnectedClients, pid: int, holder: _Guest | None = None, now_s: float = 100.0) -> _Guest | None:
    newcomer = Peer(pid, 0, frozenset())
    return cast(_Guest | None, slots.make_room(newcomer, cast(Connection | None, holder), int(now_s * 1e9)))


def test_house_with_room_sends_nobody_away() -> None:
    assert _leaves(_full(*(_Guest(pid) for pid in range(MAX_CLIENTS - 1))), 999) is None


def test_of_a_full_house_the_one_who_was_idle_longest_leaves() -> None:
    guests = [_Guest(pid, active_ns=1000 - pid) for pid in range(MAX_CLIENTS)]
    assert _leaves(_full(*guests), 999) is guests[-1]


def test_who_commands_and_who_waits_for_an_answer_stays() -> None:
    guests = [_Guest(pid, active_ns=pid) for pid in range(MAX_CLIENTS)]
    guests[1].under_way = 1
    assert _leaves(_full(*guests), 999, holder=guests[0]) is guests[2]


def test_who_commanded_or_stopped_a_moment_ago_leaves_after_all_others() -> None:
    """A stop takes no lease, and the lease goes where a client ends it; both may look at the machine for a while."""
    now_ns = 100_000_000_000
    others = [_Guest(pid, now_ns, under_way=1) for pid in range(MAX_CLIENTS - 2)]
    stopped = _Guest(500, active_ns=50_000_000_000, commanded_ns=50_000_000_000)
    long_ago = _Guest(501, active_ns=39_000_000_000, commanded_ns=39_000_000_000)
    slots = _full(stopped, long_ago, *others)
    assert _leaves(slots, 999) is long_ago
    long_ago.active_ns, long_ago.under_way = now_ns, 1
    assert _leaves(slots, 999) in [*others, long_ago]
    slots = _full(*(_Guest(pid, now_ns - pid, commanded_ns=now_ns) for pid in range(MAX_CLIENTS)))
    assert _leaves(slots, 999) is not None


def test_who_stopped_the_axis_is_not_sent_away_by_a_crowd_that_only_looks(served: Served) -> None:
    with ControlClient(served.path) as commander, ControlClient(served.path) as own, contextlib.ExitStack() as others:
        time.sleep(0.05)  # the server knows no time before its first round
        commander.call(Verb.ENABLE)
        own.call(Verb.STOP)
        for _ in range(3 * MAX_CLIENTS_OF_A_PROCESS):
            others.enter_context(raw(served)).sendall(b'{"id":1,"verb":"status"}\n')
        assert own.call(Verb.DISABLE) and commander.call(Verb.ENABLE)


def test_idle_one_leaves_before_an_active_crowd_and_that_before_an_active_single_one() -> None:
    single = [_Guest(pid, active_ns=99_000_000_000) for pid in range(100, 100 + MAX_CLIENTS - 10)]
    crowd = [_Guest(7, active_ns=99_500_000_000 + n) for n in range(10)]
    slots = _full(*single, *crowd)
    assert _leaves(slots, 999) is crowd[0]
    single[3].active_ns = 97_000_000_000
    assert _leaves(slots, 999) is single[3]


def test_nobody_who_is_active_makes_room_for_a_larger_crowd() -> None:
    now_ns = 99_000_000_000
    crowd = [_Guest(98, now_ns, under_way=1) for _ in range(3)]
    slots = _full(*crowd, *(_Guest(pid, now_ns) for pid in range(MAX_CLIENTS - 3)))
    with pytest.raises(Unreachable, match="all places are taken, 3 of them by process 98"):
        _leaves(slots, 98)


def test_of_a_process_with_its_share_its_own_oldest_leaves() -> None:
    mine = [_Guest(7, active_ns=10 - n) for n in range(MAX_CLIENTS_OF_A_PROCESS)]
    assert _leaves(_full(*mine, _Guest(8)), 7, holder=mine[-1]) is mine[-2]


def test_200_idle_clients_of_20_processes_leave_room_for_a_stop(served: Served) -> None:
    code = f"""
import os, socket, time
for _ in range(20):
    if os.fork() == 0:
        crowd = [socket.socket(socket.AF_UNIX) for _ in range(10)]
        for one in crowd:
            one.connect({str(served.path)!r})
        print(end="x", flush=True)
        time.sleep(60)
time.sleep(60)
"""
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, start_new_session=True) as crowd:
        try:
            assert crowd.stdout is not None
            crowd.stdout.read(20)
            with ControlClient(served.path) as client:
                assert client.call(Verb.STOP) == {"late": True}
        finally:
            os.killpg(crowd.pid, 9)


def test_stop_of_another_process_wins_and_the_one_who_commanded_must_come_again(served: Served) -> None:
    with ControlClient(served.path) as commander:
        commander.call(Verb.ENABLE)
        stopped = other_process(served, "client.call('stop')")
        assert stopped.returncode == 0, stopped.stderr
        with pytest.raises(Unreachable, match=r"process \d+ stopped the axis; connect again before you enable it"):
            commander.call(Verb.ENABLE)
        assert commander.call(Verb.RECORD_STOP)
    with ControlClient(served.path) as commander:
        commander.call(Verb.ENABLE)


def test_disable_needs_no_lease_and_wins_as_well(served: Served) -> None:
    with ControlClient(served.path) as commander:
        commander.call(Verb.ENABLE)
        assert other_process(served, "client.call('disable')").returncode == 0
        with pytest.raises(Unreachable, match="connect again"):
            commander.call(Verb.ENABLE)


def test_stop_on_a_second_connection_of_the_same_process_bars_nobody(served: Served) -> None:
    with ControlClient(served.path) as commander, ControlClient(served.path) as own:
        commander.call(Verb.ENABLE)
        own.call(Verb.STOP)
        commander.call(Verb.ENABLE)


def test_flood_is_served_a_little_in_each_round(served: Served) -> None:
    """Five thousand requests at once; whoever comes meanwhile does not wait for them."""
    with raw(served) as flood:
        flood.setblocking(False)
        flood.send(b'{"id":1,"verb":"status"}\n' * 5000)
        with ControlClient(served.path) as client:
            began = time.monotonic()
            client.call(Verb.STATUS)
            assert time.monotonic() - began < 0.5
        flood.setblocking(True)
        time.sleep(0.2)
        assert flood.recv(1_000_000).count(b"\n") < 500
    assert served.longest_round_s < 0.1


def test_requests_under_way_are_bounded_and_a_stop_has_room(served: Served) -> None:
    served.handler.late_verbs |= {Verb.RECORD_START}
    served.handler.patient = True
    with raw(served) as greedy:
        for number in range(12):
            greedy.sendall(json.dumps({"id": number, "verb": "record_start"}).encode() + b"\n")
        greedy.sendall(b'{"id":99,"verb":"stop"}\n')
        with greedy.makefile("rb") as lines:
            refused = [json.loads(lines.readline()) for _ in range(4)]
        assert {answer["id"] for answer in refused} == {8, 9, 10, 11}
        assert "8 requests are under way" in refused[0]["error"]["message"]
        served.handler.patient = False
        with greedy.makefile("rb") as lines:
            assert [json.loads(lines.readline())["id"] for _ in range(9)] == [*range(8), 99]


def test_answer_that_json_cannot_hold_is_told_and_ends_nothing(served: Served) -> None:
    served.handler.answer = {"torque_nm": float("nan")}
    with ControlClient(served.path) as client:
        with pytest.raises(Unreachable, match="cannot be told as JSON"):
            client.call(Verb.STATUS)
        served.handler.answer = {"torque_nm": 0.5}
        assert client.call(Verb.STATUS) == {"torque_nm": 0.5}


@pytest.mark.parametrize("line", [b'{"id":', b"x" * 300_000, b"\n" * 100_000, b"\x00" * 70_000, b" " * 600_000])
def test_half_messages_and_blanks_take_no_more_than_their_buffer(served: Served, line: bytes) -> None:
    with raw(served) as connection:
        connection.settimeout(0.2)
        try:
            connection.sendall(line)
        except (TimeoutError, OSError):
            assert len(line) > 200_000
        with ControlClient(served.path) as client:
            assert client.call(Verb.STATUS)
        assert served.server.held_bytes < 700_000


def test_too_long_a_line_says_so_before_the_end(served: Served) -> None:
    with raw(served) as connection:
        with pytest.raises(OSError):
            for _ in range(1600):
                connection.sendall(b"x" * 65_536)
        assert "a longer line" in answer_of(connection)["error"]["message"]


def test_who_had_to_make_room_hears_why(served: Served) -> None:
    with ControlClient(served.path) as first:
        first.call(Verb.STATUS)
        time.sleep(0.05)  # the next round
        crowd = [raw(served) for _ in range(MAX_CLIENTS_OF_A_PROCESS)]
        crowd[-1].sendall(b'{"id":1,"verb":"status"}\n')
        assert answer_of(crowd[-1])["ok"]
        with pytest.raises(Unreachable, match="idle for longest when others wanted its place"):
            first.call(Verb.STATUS)
    for connection in crowd:
        connection.close()


def test_come_and_go_leaves_nothing_behind(served: Served) -> None:
    for _ in range(300):
        with socket.socket(socket.AF_UNIX) as passer:
            passer.connect(str(served.path))
            passer.sendall(b'{"id":1,"verb":"stop"}\n')
    with ControlClient(served.path) as client:
        assert client.call(Verb.STOP) == {"late": True}
        assert client.call(Verb.STATUS)
    deadline = time.monotonic() + 5.0
    while served.server.held_bytes and time.monotonic() < deadline:
        time.sleep(0.01)
    assert served.server.held_bytes == 0


def test_who_leaves_a_flood_behind_gives_the_lease_back_at_once(served: Served) -> None:
    with raw(served) as flood:
        flood.sendall(b'{"id":1,"verb":"enable"}\n' * 1000)
        assert answer_of(flood)["ok"]
    with ControlClient(served.path) as next_one:
        next_one.call(Verb.ENABLE)


def test_who_only_says_no_more_still_gets_the_answers(served: Served) -> None:
    with raw(served) as last:
        last.sendall(b'{"id":1,"verb":"stop"}\n' * 20)
        last.shutdown(socket.SHUT_WR)
        with last.makefile("rb") as lines:
            assert len(lines.readlines()) == 20


def test_a_commanding_client_is_never_hung_up_on_by_a_crowd(served: Served) -> None:
    with ControlClient(served.path, 5.0) as client:
        crowd = textwrap.dedent(f"""
            import socket
            held = [socket.socket(socket.AF_UNIX) for _ in range(60)]
            for one in held:
                one.connect({str(served.path)!r})
                one.send(b'{{"id":1,"verb":"track"}}\\n' * 20)
        """)
        client.call(Verb.ENABLE)
        crowds = [subprocess.Popen([sys.executable, "-c", crowd], stderr=subprocess.DEVNULL) for _ in range(6)]
        while any(process.poll() is None for process in crowds):
            assert client.call(Verb.ENABLE)["verb"] == Verb.ENABLE
            time.sleep(0.01)
        time.sleep(2.1)
        with contextlib.ExitStack() as others:
            _ = [others.enter_context(raw(served)) for _ in range(MAX_CLIENTS + 4)]
            assert client.call(Verb.ENABLE)["verb"] == Verb.ENABLE


def test_who_is_hung_up_on_because_the_daemon_ends_is_told_so(served: Served) -> None:
    with ControlClient(served.path, 5.0) as client:
        client.call(Verb.ENABLE)
        served.close("the loop was lost")
        with pytest.raises(Unreachable, match="the loop was lost") as told:
            client.call(Verb.STATUS)
        assert not isinstance(told.value, Refused)
