"""servod on real SocketCAN (vcan) under real systemd, in the user-mode-linux guest; see guest.py."""

from typing import Any

import guest
import pytest

pytestmark = [pytest.mark.guest, pytest.mark.timeout(1500)]
Results = dict[str, dict[str, Any]]


@pytest.fixture(scope="module")
def results() -> Results:
    return {row["step"]: row for row in guest.run()}


def _of(results: Results, step: str) -> dict[str, Any]:
    assert "error" not in results[step], f"{results[step]['error']}\n{results[step].get('journal_tail')}"
    return results[step]


def test_units_verify_where_they_are_installed(results: Results) -> None:
    assert _of(results, "install")["verify"] == ""


def test_daemon_is_ready_as_its_own_user_with_real_time_rights(results: Results) -> None:
    start = _of(results, "start")
    assert (start["active"], start["axis"], start["user"]) == ("active", "DISABLED", "servod servod 660")
    assert start["nodes"] == ["OPERATIONAL", "OPERATIONAL"]
    assert start["grants"]["memory_lock"]
    assert start["grants"]["sched_fifo"]
    assert "DISABLED" in start["status_text"]


def test_only_can_and_unix_sockets_come_through(results: Results) -> None:
    families = {k: v for k, v in _of(results, "families").items() if k.startswith("AF_")}
    assert (families.pop("AF_CAN"), families.pop("AF_UNIX")) == ("allowed", "allowed")
    assert set(families.values()) == {"Address family not supported by protocol"}


def test_group_member_moves_the_axis_on_vcan(results: Results) -> None:
    motion = _of(results, "motion")
    assert motion["rows"] > 100
    assert motion["moved_rad"] > 0.1
    assert motion["after"] == "DISABLED"


def test_stranger_is_refused(results: Results) -> None:
    rights = _of(results, "rights")
    assert (rights["exit_code"], rights["axis"]) == (3, "DISABLED")
    assert rights["said"].count("\n") == 0


@pytest.mark.parametrize("step", ["watchdog", "supervisor_killed", "loop_killed"])
def test_daemon_comes_back_disabled(results: Results, step: str) -> None:
    recovered = _of(results, step)
    assert recovered["restarts"] >= 1
    assert recovered["axis"] == "DISABLED"


def test_loop_outlives_its_supervisor_and_ramps_the_torque_down(results: Results) -> None:
    killed = _of(results, "supervisor_killed")
    assert killed["torque_before_nm"] > 0.05
    assert killed["torque_at_end_nm"] < 0.02
    assert killed["drive_states"][0] == "OPERATION_ENABLED"
    assert not {"FAULT", "FAULT_REACTION_ACTIVE", "QUICK_STOP_ACTIVE"} & set(killed["drive_states"])


def test_watchdog_and_lost_loop_are_told(results: Results) -> None:
    assert _of(results, "watchdog")["journal"]
    assert _of(results, "loop_killed")["told"]
    assert _of(results, "loop_killed")["files"] >= 1


def test_bad_configuration_fails_once_with_its_line(results: Results) -> None:
    bad = _of(results, "bad_configuration")
    assert (bad["state"], bad["exit_code"], bad["restarts"]) == ("failed", 2, 0)
    assert "did you mean amplifier" in bad["line"]


def test_stop_is_orderly(results: Results) -> None:
    stop = _of(results, "stop")
    assert (stop["result"], stop["active"], stop["socket_left"]) == ("success", "inactive", False)
    assert stop["stopped_in_order"]
    assert stop["metrics"]
