"""Every way of dying ends with torque zero within 300 ms, as the drive's own record shows, by the documented path."""

import os
import signal
import time
from pathlib import Path

import pytest
from machine import Machine, machine

from servod.hal import DriveState

LIMIT_NS = 300_000_000
#: The drive's torque is counted in per mille of its rated torque: one count is zero to within its resolution.
NO_TORQUE_NM = 1e-9

_ENABLED = DriveState.OPERATION_ENABLED


def loop_pid(m: Machine) -> int:
    """The daemon's only child (proc(5), task/children)."""
    (pid,) = Path(f"/proc/{m.daemon.pid}/task/{m.daemon.pid}/children").read_text().split()
    return int(pid)


def has_ended(pid: int) -> bool:
    """No such process, or a zombie that its new parent has not collected yet."""
    stat = Path(f"/proc/{pid}/stat")
    return not stat.exists() or stat.read_text().rsplit(")", 1)[1].split()[0] == "Z"


def states_since(m: Machine, time_ns: int) -> set[DriveState]:
    """States of the drive from `time_ns` to the end of its record."""
    return {DriveState(s.state) for s in m.drive_samples() if s.time_ns > time_ns}


def torque_is_gone(m: Machine, killed_ns: int) -> None:
    """From 300 ms after the kill to the end of the record there is no torque, and before it there was some."""
    samples = m.drive_samples()
    before = [s for s in samples if killed_ns - 200_000_000 < s.time_ns < killed_ns]
    after = [s for s in samples if s.time_ns > killed_ns + LIMIT_NS]
    assert max(abs(s.torque_nm) for s in before) > 0.01
    assert after, "the drive's record ends too early"
    assert max(abs(s.torque_nm) for s in after) <= NO_TORQUE_NM
    assert all(s.state != _ENABLED for s in after)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=["ctrl-c", "sigterm"])
def test_asked_to_stop_the_daemon_ramps_down_and_ends_with_0(tmp_path, number):
    with machine(tmp_path) as m:
        client = m.client()
        m.start_moving(client)
        asked_ns = time.monotonic_ns()
        m.daemon.send_signal(number)
        assert m.daemon.wait(5.0) == 0
        time.sleep(0.5)
        torque_is_gone(m, asked_ns)
        assert states_since(m, asked_ns) <= {_ENABLED, DriveState.SWITCH_ON_DISABLED}
        assert not (tmp_path / "axis.sock").exists()


def test_loop_killed_the_drive_stops_by_its_own_heartbeat_consumer_or_sooner(tmp_path):
    with machine(tmp_path) as m:
        client = m.client()
        m.start_moving(client)
        pid = loop_pid(m)
        killed_ns = time.monotonic_ns()
        os.kill(pid, signal.SIGKILL)
        assert m.daemon.wait(10.0) != 0
        time.sleep(0.3)
        torque_is_gone(m, killed_ns)
        assert "LOOP_LOST" in (tmp_path / "daemon.log").read_text()


def test_supervisor_killed_the_loop_brakes_ramps_down_and_ends(tmp_path):
    with machine(tmp_path) as m:
        client = m.client()
        m.start_moving(client)
        pid = loop_pid(m)
        killed_ns = time.monotonic_ns()
        m.daemon.kill()
        m.daemon.wait()
        time.sleep(0.6)
        torque_is_gone(m, killed_ns)
        assert has_ended(pid)
        # The loop itself switched off: no quick stop of the drive's own, and no fault for want of a heartbeat.
        assert DriveState.QUICK_STOP_ACTIVE not in states_since(m, killed_ns)


def test_loop_and_supervisor_killed_together_leave_the_drive_to_its_heartbeat_consumer(tmp_path):
    with machine(tmp_path) as m:
        client = m.client()
        m.start_moving(client)
        pid = loop_pid(m)
        killed_ns = time.monotonic_ns()
        os.kill(pid, signal.SIGSTOP)  # neither can act on the other's death
        m.daemon.kill()
        os.kill(pid, signal.SIGKILL)
        time.sleep(0.6)
        torque_is_gone(m, killed_ns)
        assert DriveState.QUICK_STOP_ACTIVE in states_since(m, killed_ns)  # 0x1016 and 0x6007, nobody else was left


def test_virtual_axis_killed_the_daemon_goes_to_fault_and_asks_for_no_torque(tmp_path):
    with machine(tmp_path) as m:
        client = m.client()
        m.start_moving(client)
        killed_ns = time.monotonic_ns()
        m.virtual_axis.kill()
        m.virtual_axis.wait()
        status = m.wait_for(client, "FAULT", timeout_s=1.0)
        assert time.monotonic_ns() - killed_ns < 1_000_000_000
        assert status["motion"]["torque_nm"] == 0.0
        names = {f["code"] for f in status["faults"]}
        assert names & {"FEEDBACK_STALE", "BUS_DOWN"}
        last = m.drive_samples()[-1]
        assert last.time_ns <= killed_ns + 50_000_000
