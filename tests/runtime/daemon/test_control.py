import asyncio
import contextlib
import json
import os
import socket
import stat
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from running import wait_for
from served import Echo, Served, answer_of, raw

from servod.client.control import ControlClient
from servod.common.errors import AnswerIsNo, BadInput, ServodError, Unreachable
from servod.formats.config import ControlConfig
from servod.formats.protocol import MAX_LINE_BYTES, PIECE_SAMPLES, Verb
from servod.runtime.daemon.control_server import ControlServer
from servod.runtime.daemon.peer import Peer, may_command, peer_of


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Served]:
    served = Served(tmp_path / "axis.sock")
    yield served
    served.close()


def test_call_gives_the_result(served: Served) -> None:
    with ControlClient(served.path) as client:
        assert client.call(Verb.TRACK, kind="sine", amplitude_rad=0.1)["args"] == {"kind": "sine", "amplitude_rad": 0.1}
        assert client.call("stop") == {"late": True}


@pytest.mark.parametrize(("code", "kind"), [(1, AnswerIsNo), (2, BadInput), (3, Unreachable)])
def test_errors_keep_their_kind_and_are_one_line(served: Served, code: int, kind: type[ServodError]) -> None:
    with ControlClient(served.path) as client, pytest.raises(kind) as caught:
        client.call(Verb.SCAN, code=code)
    assert caught.value.exit_code == code
    assert "\n" not in str(caught.value)


def test_socket_is_for_owner_and_group_only_and_goes_away(served: Served) -> None:
    assert stat.S_IMODE(served.path.stat().st_mode) == 0o660
    served.close()  # in its own thread, whose next round would make a socket that is gone again
    assert not served.path.exists()


def test_socket_that_somebody_removed_is_made_again(served: Served) -> None:
    with ControlClient(served.path) as before:
        before.call(Verb.STATUS)  # it has its place
        served.path.unlink()
        with pytest.raises(Unreachable):
            ControlClient(served.path)
        wait_for(served.path.exists)
        with ControlClient(served.path) as newcomer:
            assert newcomer.call(Verb.GAINS_KEEP)["verb"] == "gains_keep"
        assert before.call(Verb.STATUS)["verb"] == "status"
        assert stat.S_IMODE(served.path.stat().st_mode) == 0o660
    served.close()
    assert not served.path.exists()


def test_who_queued_when_the_socket_was_made_again_is_served(tmp_path: Path) -> None:
    path, handler = tmp_path / "axis.sock", Echo()

    async def told() -> bytes:
        server = ControlServer(ControlConfig(socket=path), handler)
        server.begin()
        with socket.socket(socket.AF_UNIX) as client:
            client.connect(str(path))  # nobody has taken it yet
            client.sendall(b'{"id": 1, "verb": "status"}\n')
            path.unlink()
            server.tick(time.monotonic_ns())
            assert path.exists()
            client.setblocking(False)
            try:
                async with asyncio.timeout(5.0):
                    while True:
                        server.tick(time.monotonic_ns())
                        await asyncio.sleep(0.01)
                        with contextlib.suppress(BlockingIOError):
                            return client.recv(4096)
            finally:
                server.close()

    assert json.loads(asyncio.run(told()))["ok"] is True


def test_stale_socket_is_replaced_and_other_files_are_not(tmp_path: Path) -> None:
    path = tmp_path / "axis.sock"
    with socket.socket(socket.AF_UNIX) as stale:
        stale.bind(str(path))
    ControlServer(ControlConfig(socket=path), Echo()).close()
    path.write_text("precious")
    with pytest.raises(Unreachable, match="cannot listen"):
        ControlServer(ControlConfig(socket=path), Echo())
    assert path.read_text() == "precious"


def test_no_daemon_is_unreachable(tmp_path: Path) -> None:
    with pytest.raises(Unreachable, match="is servod running"):
        ControlClient(tmp_path / "none.sock")


def test_one_client_commands_the_others_watch_and_may_stop(served: Served) -> None:
    with ControlClient(served.path) as other:
        with ControlClient(served.path) as first:
            first.call(Verb.ENABLE)
            with pytest.raises(Unreachable, match="commands the axis"):
                other.call(Verb.ENABLE)
            assert other.call(Verb.STATUS)
            assert other.call(Verb.STOP) == {"late": True}
            assert served.server.lease()["pid"] > 0
        assert _free(served)
        other.call(Verb.ENABLE)


def _free(served: Served) -> bool:
    deadline = time.monotonic() + 5
    while served.server.lease()["pid"] and time.monotonic() < deadline:
        time.sleep(0.01)
    return not served.server.lease()["pid"]


def test_motion_that_a_client_left_behind_can_only_be_ended_by_others(served: Served) -> None:
    with ControlClient(served.path) as first:
        first.call(Verb.TRACK, kind="sine")
    assert _free(served)
    served.handler.moves = True
    with ControlClient(served.path) as other:
        for verb in (Verb.ENABLE, Verb.TRACK, Verb.GAINS_ACTIVATE, Verb.TRAJECTORY):
            with pytest.raises(Unreachable, match=f"a motion that process {os.getpid()} started runs"):
                other.call(verb)
        for verb in (Verb.DISABLE, Verb.HALT, Verb.STOP):
            assert other.call(verb)
        served.handler.moves = False
        other.call(Verb.TRACK, kind="paper")
        served.handler.moves = True
        other.call(Verb.ENABLE)
    assert _free(served)
    assert served.handler.ended_leases == 2


def test_many_samples_go_ahead_in_pieces_and_few_do_not(served: Served) -> None:
    way = [0.1 * k for k in range(4500)]
    with ControlClient(served.path) as client:
        args = client.call(Verb.TRACK, kind="csv", positions_rad=way)["args"]
        assert args == {"kind": "csv", "uploaded": True}
        assert [(key, start, len(piece)) for key, start, piece in served.handler.pieces] == [
            ("positions_rad", 0, 2000),
            ("positions_rad", 2000, 2000),
            ("positions_rad", 4000, 500),
        ]
        assert [x for _, _, piece in served.handler.pieces for x in piece] == way
        assert client.call(Verb.TRACK, kind="csv", positions_rad=way[:9])["args"]["positions_rad"] == way[:9]


def test_widest_piece_fits_into_a_line(served: Served) -> None:
    with ControlClient(served.path) as client:
        client.call(Verb.TRACK, positions_rad=[-1.2345678901234567e-300] * (PIECE_SAMPLES + 1))
        with pytest.raises(BadInput, match=f"at most {MAX_LINE_BYTES} bytes"):
            client.call(Verb.GAINS_LOAD, text="x" * MAX_LINE_BYTES)


def test_error_that_nobody_foresaw_ends_the_request_only(served: Served) -> None:
    with ControlClient(served.path) as client:
        with pytest.raises(Unreachable, match="nobody foresaw"):
            client.call(Verb.GAINS_LIST)
        assert client.call(Verb.STATUS)


def test_status_that_cannot_be_made_is_told_and_logged_once(served: Served, caplog: pytest.LogCaptureFixture) -> None:
    served.handler.broken = True
    connection = raw(served)
    connection.sendall(b'{"id":1,"verb":"watch","args":{"period_s":0.02}}\n')
    with connection.makefile("rb") as lines:
        answers = [json.loads(lines.readline()) for _ in range(3)]
    assert {a["error"]["exit_code"] for a in answers} == {3}
    assert "a bad byte" in answers[0]["error"]["message"]
    assert [r.getMessage() for r in caplog.records] == ["the status cannot be made"]
    served.handler.broken = False
    with ControlClient(served.path) as client:
        assert client.call(Verb.STATUS)
    connection.close()


@pytest.mark.parametrize(
    ("line", "says"),
    [
        (b"garbage", "one JSON object"),
        (b"[1,2]", "not a JSON object"),
        (b'{"id":1,"verb":"fly"}', "'fly'; allowed: status"),
        (b'{"id":1,"verb":["status"]}', "allowed: status"),
        (b'{"id":1,"verb":"track","args":[1]}', "found list"),
        (b'{"id":1,"verb":"watch","args":{"period_s":"x"}}', "watch: period_s"),
        (b'{"id":1,"verb":"watch","args":{"period_s":1e-9}}', "watch: period_s"),
        (b"\xff\xfe\x00", "one JSON object"),
        (b"[" * 60_000, "one JSON object"),
        (b'{"id":NaN,"verb":"status"}', "request: id: found nan"),
        (b'{"id":1e999,"verb":"status"}', "request: id: found inf"),
        (b'{"id":"' + b"9" * 65 + b'","verb":"status"}', "at most 64 characters"),
        (b'{"id":[[]],"verb":"status"}', "request: id: found [[]]"),
        (b'{"id":1,"verb":"watch","args":{"period_s":NaN}}', "watch: period_s"),
    ],
)
def test_bad_lines_get_one_line_back_and_the_connection_goes_on(served: Served, line: bytes, says: str) -> None:
    connection = raw(served)
    connection.sendall(line + b"\n")
    answer = answer_of(connection)
    assert (answer["ok"], answer["error"]["exit_code"]) == (False, 2)
    assert says in answer["error"]["message"]
    connection.sendall(b'{"id":7,"verb":"status"}\n')
    assert answer_of(connection)["id"] == 7
    connection.close()


def test_line_in_pieces_and_several_lines_at_once(served: Served) -> None:
    connection = raw(served)
    for piece in (b'{"id":1,"ve', b'rb":"status"', b'}\n{"id":2,"verb":"status"}\n\n{"id":3', b',"verb":"status"}\n'):
        connection.sendall(piece)
        time.sleep(0.01)
    with connection.makefile("rb") as lines:
        assert [json.loads(lines.readline())["id"] for _ in range(3)] == [1, 2, 3]
    connection.close()


def test_line_without_end_loses_its_connection(served: Served) -> None:
    connection = raw(served)
    with pytest.raises(OSError):
        for _ in range(MAX_LINE_BYTES // 65_536 + 64):
            connection.sendall(b"x" * 65_536)
    connection.close()
    with ControlClient(served.path) as client:
        assert client.call(Verb.STATUS)


def test_long_line_is_refused_before_anything_is_made_of_it(served: Served) -> None:
    connection = raw(served)
    connection.sendall(b'{"id":1,"verb":"status","args":{"a":[' + b"[]," * (MAX_LINE_BYTES // 3) + b"[]]}}\n")
    answer = answer_of(connection)
    assert (answer["error"]["exit_code"], answer["id"]) == (2, None)
    assert f"at most {MAX_LINE_BYTES} bytes" in answer["error"]["message"]
    connection.close()


def test_client_that_never_reads_is_served_no_more_and_disturbs_nobody(served: Served) -> None:
    deaf = raw(served)
    deaf.settimeout(0.3)
    request = json.dumps({"id": 1, "verb": "track", "args": {"kind": "x" * 50_000}}).encode() + b"\n"
    with pytest.raises(TimeoutError):
        for _ in range(1000):
            deaf.sendall(request)
    with ControlClient(served.path) as client:
        assert client.call(Verb.STATUS)
    assert served.server.held_bytes < 400_000
    assert served.longest_round_s < 1.0
    deaf.close()


def test_watch_streams_and_a_deaf_watcher_only_loses_lines(served: Served) -> None:
    deaf = raw(served)
    deaf.sendall(b'{"id":1,"verb":"watch","args":{"period_s":0.02}}\n')
    with ControlClient(served.path) as client:
        stream = client.watch(0.02)
        times = [next(stream)["now"] for _ in range(5)]
    assert times == sorted(times)
    assert times[-1] - times[0] >= 0.06
    deaf.close()


def test_one_program_cannot_take_all_places(served: Served) -> None:
    crowd = [raw(served) for _ in range(40)]
    assert "idle for longest" in answer_of(crowd[0])["error"]["message"]
    code = f"""
from servod.client.control import ControlClient
with ControlClient({str(served.path)!r}) as client:
    client.call("status"), client.call("stop")
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    for connection in crowd:
        connection.close()


def test_kernel_tells_the_peers_process_and_all_its_groups(tmp_path: Path) -> None:
    further = [54321, 54322] if os.geteuid() == 0 else os.getgroups()
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(tmp_path / "s"))
        listener.listen()
        listener.settimeout(10)
        code = f"import socket; s = socket.socket(socket.AF_UNIX); s.connect({str(tmp_path / 's')!r}); s.recv(1)"
        child = subprocess.Popen([sys.executable, "-c", code], extra_groups=further if os.geteuid() == 0 else None)
        connection, _ = listener.accept()
        peer = peer_of(connection)
        connection.close()
        child.wait(10)
    assert (peer.pid, peer.uid) == (child.pid, os.geteuid())
    assert peer.groups == {os.getegid(), *further}


@pytest.mark.parametrize(
    ("uid", "groups", "group", "may"),
    [(0, {0}, None, True), (1234, {100, 55}, 55, True), (1234, {100}, 55, False), (1234, {100}, None, False)],
)
def test_root_and_group_may_command(uid: int, groups: set[int], group: int | None, may: bool) -> None:
    assert may_command(Peer(1, uid, frozenset(groups)), group) is may
