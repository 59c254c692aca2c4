"""servod on real SocketCAN (vcan) under real systemd, in the user-mode-linux guest; see guest.py."""

from typing import Any

import guest
import pytest

pytestmark = [pytest.mark.guest, pytest.mark.timeout(1500)]
Results = dict[str, dict[str, Any]]

_REFUSED_FAMILY, _READ_ONLY = "Address family not supported by protocol", "Read-only file system"
SYNC, COMMAND, DRIVE, ENCODER = "080", "201", "181", "282"


@pytest.fixture(scope="module")
def results() -> Results:
    return {row["step"]: row for row in guest.run()}


def _of(results: Results, step: str) -> dict[str, Any]:
    assert "error" not in results[step], f"{results[step]['error']}\n{results[step].get('journal_tail')}"
    return results[step]


def test_units_verify_where_they_are_installed(results: Results) -> None:
    assert _of(results, "install")["verify"] == ""


def test_the_service_is_ready_only_after_the_axis_answers(results: Results) -> None:
    readiness = _of(results, "readiness")
    assert "active" not in readiness["before"]
    assert len(readiness["said"]) == 1, "without an axis, one line says why"


def test_daemon_is_ready_as_its_own_user_with_real_time_rights(results: Results) -> None:
    started = _of(results, "started")
    assert (started["active"], started["axis"], started["daemon_user"]) == ("active", "DISABLED", "servod")
    assert started["user"] == "servod servod 660", "the socket is for the group, and for nobody else"
    assert started["nodes"] == ["OPERATIONAL", "OPERATIONAL"]
    assert started["grants"]["memory_lock"]
    assert started["grants"]["sched_fifo"]
    assert "DISABLED" in started["status_text"]


def test_only_can_and_unix_sockets_come_through(results: Results) -> None:
    families = dict(_of(results, "sandbox")["families"])
    assert (families.pop("AF_CAN"), families.pop("AF_UNIX")) == ("allowed", "allowed")
    assert set(families.values()) == {_REFUSED_FAMILY}


def test_the_file_system_is_read_only_but_for_its_own_folders(results: Results) -> None:
    folders = dict(_of(results, "sandbox")["folders"])
    own = ("/run/servod", "/var/lib/servod", "/tmp")
    assert [folders.pop(name) for name in own] == ["writable"] * len(own)
    assert set(folders.values()) <= {_READ_ONLY, "Permission denied", "No such file or directory"}
    assert folders["/opt"] == folders["/usr/local/lib"] == _READ_ONLY


def test_the_daemon_has_no_privileges_and_gets_none(results: Results) -> None:
    sandbox = _of(results, "sandbox")
    process = sandbox["process"]
    assert sandbox["user"] != 0
    assert (process["NoNewPrivs"], process["Seccomp"]) == ("1", "2")
    assert int(process["CapEff"], 16) == int(process["CapBnd"], 16) == 0
    assert sandbox["exposure"] < 3.0, "systemd-analyze security: the lower, the better"


def test_the_conformance_suite_passes_on_vcan(results: Results) -> None:
    conformance = _of(results, "conformance")
    assert conformance["exit_code"] == 0, conformance["said"]
    assert "passed" in conformance["said"]


def test_group_member_moves_the_axis_on_vcan(results: Results) -> None:
    motion = _of(results, "motion")
    assert motion["rows"] > 100
    assert motion["moved_rad"] > 0.1
    assert motion["after"] == "DISABLED"


def test_candump_sees_every_frame_of_the_cycle(results: Results) -> None:
    witness = _of(results, "witness")
    counts, lengths = witness["counts"], witness["lengths"]
    assert counts[SYNC] > 50
    for can_id in (COMMAND, DRIVE, ENCODER):
        assert abs(counts[can_id] - counts[SYNC]) <= 3, f"{can_id} does not come with each SYNC: {counts}"
    assert (lengths[SYNC], lengths[COMMAND], lengths[DRIVE], lengths[ENCODER]) == ([0], [4], [8], [4])


def test_stranger_is_refused(results: Results) -> None:
    rights = _of(results, "rights")
    assert (rights["exit_code"], rights["axis"]) == (3, "DISABLED")
    assert rights["said"].count("\n") == 0


def test_reload_checks_the_files_and_leaves_the_axis_alone(results: Results) -> None:
    reload = _of(results, "reload")
    assert reload["good"] == 0
    assert reload["bad"] != 0
    assert (reload["same_process"], reload["axis"], reload["told"]) == (True, "ENABLED", True)


def test_restart_comes_back_disabled(results: Results) -> None:
    restart = _of(results, "restart")
    assert (restart["other_process"], restart["axis"], restart["in_order"]) == (True, "DISABLED", True)


@pytest.mark.parametrize("step", ["watchdog", "loop_stopped", "supervisor_killed", "loop_killed"])
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
    assert _of(results, "loop_stopped")["told"]
    assert _of(results, "loop_killed")["files"] >= 1


def test_the_journal_has_fault_and_remedy_as_an_error(results: Results) -> None:
    killed = _of(results, "loop_killed")
    assert (killed["levels"], killed["remedy"]) == (["3"], True)


def test_the_fault_campaign_passes_on_vcan(results: Results) -> None:
    scenarios = _of(results, "campaign")["scenarios"]
    assert len(scenarios) >= 10
    assert {name: row["complaints"] for name, row in scenarios.items() if row["complaints"]} == {}


def test_bad_configuration_fails_once_with_its_line(results: Results) -> None:
    bad = _of(results, "bad_configuration")
    assert (bad["state"], bad["exit_code"], bad["restarts"]) == ("failed", 2, 0)
    assert "did you mean amplifier" in bad["line"]


def test_stop_is_orderly(results: Results) -> None:
    stop = _of(results, "stop")
    assert (stop["result"], stop["active"], stop["socket_left"]) == ("success", "inactive", False)
    assert stop["stopped_in_order"]
    assert stop["metrics"]
