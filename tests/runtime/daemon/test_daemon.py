"""The daemon as a whole, over its control socket, with loop, bus and drive behind it."""

import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from prometheus_client.parser import text_string_to_metric_families
from running import Running, answers, at_rest, running, wait_for

from servod.client.control import ControlClient
from servod.common.errors import BadInput, Unreachable
from servod.common.shipped import shipped
from servod.formats.recording.mcap_reader import read_recording


@pytest.fixture
def client(axis: Running) -> Iterator[ControlClient]:
    with ControlClient(axis.socket) as client:
        yield client
        client.call("disable")


def _position(client: ControlClient) -> float:
    return float(client.call("status")["motion"]["position_rad"])


def test_status_after_start_is_disabled_and_healthy(client: ControlClient) -> None:
    status = client.call("status")
    assert (status["axis"]["state"], status["drive"]["state"]) == ("DISABLED", "SWITCH_ON_DISABLED")
    assert status["controller"] == {"serial": 0, "name": "demo_pd", "law": "pd", "note": ""}
    assert 0.3 < status["bus"]["load"] < 0.5
    wait_for(lambda: {n["state"] for n in client.call("status")["nodes"]} == {"OPERATIONAL"})
    assert {g["name"] for g in status["grants"]} >= {"memory_lock", "sched_fifo", "cpu_affinity"}
    assert status["loop"]["pid"] > 0


def test_a_motion_moves_the_axis_and_the_recording_shows_it(axis: Running, client: ControlClient) -> None:
    enabled = client.call("enable")
    assert (enabled["state"], enabled["wiring"]["finding"]) == ("ENABLED", "PASSED")
    start_rad = _position(client)
    path = client.call("record_start", path="motion.mcap")["path"]
    way = [0.05 * (1 - math.cos(math.pi * k / 500)) / 2 for k in range(501)]
    client.call("track", kind="csv", positions_rad=way)
    wait_for(at_rest(client))
    assert 0.005 < _position(client) - start_rad < 0.06  # the joint sticks, and PD leaves an error
    records = client.call("record_stop")["records"]
    recording = read_recording(path)
    times_ns = recording.column("time_ns")
    assert records == len(times_ns) and times_ns[-1] - times_ns[0] > 400_000_000  # a busy machine skips cycles
    assert set(recording.attachments) == {"config.yaml", "gains.yaml"}
    assert max(recording.column("reference_rad")) == pytest.approx(start_rad + 0.05, abs=1e-3)
    assert [e["text"] for e in recording.events if e["kind"] == "command"] == ["reference"]
    assert Path(path).parent == axis.folder / "recordings"


def test_motions_are_refused_with_the_reason(client: ControlClient) -> None:
    with pytest.raises(Unreachable, match="not enabled"):
        client.call("track", kind="paper", duration_s=1)
    client.call("enable")
    with pytest.raises(Unreachable, match="position_min_rad"):
        client.call("track", kind="step", amplitude_rad=2.0, duration_s=1)
    with pytest.raises(BadInput, match="duration_s"):
        client.call("track", kind="paper")
    client.call("track", kind="sine", amplitude_rad=0.01, frequency_hz=1, duration_s=30)
    wait_for(lambda: not at_rest(client)())
    with pytest.raises(Unreachable, match="a motion is running"):
        client.call("track", kind="paper", duration_s=1)
    with pytest.raises(Unreachable, match="needs the axis disabled"):
        client.call("scan")
    assert client.call("stop")["state"] == "DISABLED"


def test_halt_holds_and_goes_on(client: ControlClient) -> None:
    client.call("enable")
    client.call("track", kind="sine", amplitude_rad=0.02, frequency_hz=1, duration_s=30, renew_s=None)
    client.call("halt", on=True)
    time.sleep(0.5)
    held = [client.call("status")["motion"]["reference_rad"] for _ in range(3)]
    assert max(held) - min(held) < 1e-6
    client.call("halt", on=False)
    wait_for(lambda: abs(client.call("status")["motion"]["reference_rad"] - held[0]) > 1e-3)


def test_gain_sets_change_while_the_axis_runs_and_roll_back(client: ControlClient) -> None:
    client.call("enable")
    text = shipped("gains/demo_pd_lugre.yaml").read_text()
    name = client.call("gains_load", name="try", text=text)["name"]
    client.call("gains_activate", name=name)
    assert client.call("status")["controller"]["law"] == "pd_lugre"
    active = [row["name"] for row in client.call("gains_list")["gains"] if row["active"]]
    assert active == [name]
    assert client.call("gains_rollback")["name"] == "demo_pd"
    wait_for(lambda: client.call("status")["controller"]["name"] == "demo_pd")
    with pytest.raises(BadInput, match="unheard"):
        client.call("gains_activate", name="unheard")
    with pytest.raises(BadInput, match="try"):
        client.call("gains_load", name="try", text="law: [")


def test_scan_finds_both_nodes_and_is_nobody_else(client: ControlClient, axis: Running) -> None:
    nodes = client.call("scan")["nodes"]
    assert [(n["node_id"], n["identity"]["device_type"] & 0xFFFF) for n in nodes] == [(1, 402), (2, 406)]
    assert "FOREIGN_SDO" not in axis.log
    client.call("enable")
    client.call("disable")


def test_scan_of_a_bus_that_a_daemon_owns_goes_through_the_daemon(axis: Running) -> None:
    def scan(socket: Path) -> subprocess.CompletedProcess[str]:
        bus = ["--interface", "virtual", "--channel", str(axis.folder / "bus")]
        command = [sys.executable, "-m", "servod.cli", "scan", *bus, "--socket", str(socket), "--json"]
        return subprocess.run(command, capture_output=True, text=True)

    done = scan(axis.socket)
    assert [node["node_id"] for node in json.loads(done.stdout)["nodes"]] == [1, 2]
    refused = scan(axis.folder / "none.sock")
    assert refused.returncode == 3
    assert f"another servod (process {axis.daemon.pid}) owns it; ask it" in refused.stderr


def test_second_daemon_is_refused_with_the_holder_and_leaves_the_first_alone(
    axis: Running, client: ControlClient
) -> None:
    command = [sys.executable, "-m", "servod.runtime.daemon.main", "--config", str(axis.folder / "axis.yaml")]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 3
    assert f"another servod (process {axis.daemon.pid}) owns it" in done.stderr
    assert client.call("status")


def test_manager_is_told_ready_status_and_fed(axis: Running) -> None:
    told = axis.told()
    wait_for(lambda: told.extend(axis.told()) or told.count("WATCHDOG=1") > 3)
    assert told[0].startswith("READY=1\n")
    assert any(line.startswith("STATUS=") and "lag p50" in line for line in told)


def test_metrics_textfile_is_kept_up_to_date(axis: Running) -> None:
    path = axis.folder / "axis.prom"
    wait_for(path.exists)
    families = {f.name for f in text_string_to_metric_families(path.read_text())}
    assert {"servod_wakeup_lag_seconds", "servod_axis_state", "servod_missed_cycles"} <= families


def test_stopped_loop_ends_the_watchdog_food_and_then_the_daemon(tmp_path: Path) -> None:
    with running(tmp_path) as axis:
        with ControlClient(axis.socket) as client:
            client.call("enable")
            pid = client.call("status")["loop"]["pid"]
        time.sleep(0.3)
        os.kill(pid, signal.SIGSTOP)
        time.sleep(0.2)
        axis.told()
        time.sleep(0.5)
        assert "WATCHDOG=1" not in axis.told()
        assert axis.daemon.wait(10) == 3
        assert "LOOP_LOST" in axis.log
        assert "it hung" in axis.log
        assert not axis.socket.exists()
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)
        (path,) = (tmp_path / "recordings").glob("tried-fault-*-LOOP_LOST.mcap")
    recording = read_recording(path)
    assert len(recording) > 100
    assert "LOOP_LOST" in {e.get("code") for e in recording.events}


def _told_by(*words: str) -> dict[str, Any]:
    command = [sys.executable, "-m", "servod.cli", "faults", *words, "--json"]
    document: dict[str, Any] = json.loads(subprocess.run(command, check=True, capture_output=True).stdout)
    return document


def _told_by_files(folder: Path) -> list[dict[str, Any]]:
    return _lost(_told_by("--recordings", str(folder / "recordings")))


def _lost(document: dict[str, Any]) -> list[dict[str, Any]]:
    return [row for row in document["incidents"] if row["code"] == "DAEMON_LOST"]


def test_daemon_starts_again_after_kill_9(tmp_path: Path) -> None:
    with running(tmp_path) as axis:
        axis.daemon.kill()
        axis.daemon.wait()
        assert axis.socket.exists()
        time.sleep(1.0)
        (gone,) = _told_by_files(tmp_path)
        assert (gone["code"], gone["axis"]) == ("DAEMON_LOST", "tried")
        command = [sys.executable, "-m", "servod.runtime.daemon.main", "--config", str(tmp_path / "axis.yaml")]
        with subprocess.Popen(command, stderr=subprocess.PIPE) as second:
            try:
                wait_for(lambda: answers(axis.socket) or second.poll() is not None, 60.0)
                with ControlClient(axis.socket) as client:
                    assert client.call("status")["axis"]["state"] == "DISABLED"
                    told, *_ = client.call("faults")["incidents"]  # a busy machine adds late cycles behind it
                    assert (told["code"], told["time"]) == ("DAEMON_LOST", gone["time"])
                shown = _lost(_told_by("--socket", str(axis.socket)))
                assert [row["detail"] for row in shown] == [told["detail"]]  # by daemon and mark, and shown once
            finally:
                second.send_signal(signal.SIGTERM)
            assert second.wait(10) == 0, second.stderr.read() if second.stderr else ""
        assert not axis.socket.exists()
        assert [row["detail"] for row in _told_by_files(tmp_path)] == [told["detail"]]  # its own end was orderly
