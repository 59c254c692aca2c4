"""servod on real SocketCAN (vcan) under real systemd, in the user-mode-linux guest; see guest.py."""

import os
import random
from typing import Any

import pytest

from tests.guest import guest

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
    assert len(readiness["said"]) == 2, "one line says that there is no interface, one that there is no axis"
    assert "no such device" in readiness["no_interface"]
    assert readiness["status_text"].startswith("waits for bus and nodes") and "node 1" in readiness["status_text"]
    assert readiness["restarts"] == 0


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


def test_loop_outlives_its_supervisor_and_brakes_to_rest(results: Results) -> None:
    killed = _of(results, "supervisor_killed")
    assert killed["torque_before_nm"] > 0.05
    assert killed["speed_at_end_rad_s"] < 0.05
    assert killed["torque_at_end_nm"] < 0.05, "less than it sticks with: the ramp is over"
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
    failed = {name: row for name, row in scenarios.items() if row["complaints"]}
    said = "\n".join(f"{name}: {key}: {value}" for name, row in failed.items() for key, value in row.items())
    assert not failed, said


def test_bad_configuration_fails_once_with_its_line(results: Results) -> None:
    bad = _of(results, "bad_configuration")
    assert (bad["state"], bad["exit_code"], bad["restarts"]) == ("failed", 2, 0)
    assert "did you mean amplifier" in bad["line"]


def test_stop_is_orderly(results: Results) -> None:
    stop = _of(results, "stop")
    assert (stop["result"], stop["active"], stop["socket_left"]) == ("success", "inactive", False)
    assert stop["stopped_in_order"]
    assert stop["metrics"]


def test_a_power_cut_loses_at_most_the_last_second() -> None:
    """At random moments of motions, faults and changes of gains; SERVOD_POWER_CUTS says how many."""
    seed = random.randrange(1 << 30)
    cuts = guest.cut(int(os.environ.get("SERVOD_POWER_CUTS", "3")), random.Random(seed))
    lost_s = max((file.get("lost_s", 0.0) for cut in cuts for file in cut["files"]), default=0.0)
    print(f"seed {seed}: {len(cuts)} cuts, {sum(len(cut['files']) for cut in cuts)} files, at most {lost_s:.2f} s lost")
    for number, cut in enumerate(cuts):
        where = f"seed {seed}, cut {number}: {cut}"
        assert (cut["boot"], cut["note"]) == ("DISABLED", ""), where
        assert cut["active"] in cut["may"], where
        assert cut["running"] == [cut["active"]], where
        for file in cut["files"]:
            assert file["lost_s"] <= 1.0, where
            assert file["whole"] or not file["closed"], where


if guest.THIRD_PARTY.is_dir():

    def test_devices_of_other_people_are_brought_up_moved_killed_and_recovered(results: Results) -> None:
        found = _of(results, "foreign")
        assert found["nodes"] == ["OPERATIONAL", "OPERATIONAL"]
        assert (found["powered"], found["torque_nm"], found["emergency"]) == (1, 0.0, True)
        assert min(found["moved_rad"], found["again_rad"]) > 0.1
        assert (found["axis"], found["powered_at_end"]) == ("DISABLED", 0)

    def test_the_default_times_hold_on_socketcan_when_all_are_scaled(results: Results) -> None:
        found = _of(results, "foreign")
        stopping = {"FEEDBACK_STALE", "DEADLINE_BUDGET", "NODE_HEARTBEAT_LOST", "DRIVE_FAULT"}
        assert (found["moving"], stopping & set(found["faults"])) == ("ENABLED", set())
        assert found["stopped_ms"] < 150.0, "0x1016 is two periods of 50 ms, scaled"


def test_nobody_but_root_sends_on_a_bus_in_a_namespace_of_its_own(results: Results) -> None:
    own = _of(results, "own_bus")
    assert own["before"] == ""  # where the interface lies open, anybody sends
    assert {how for how, said in own["said"].items() if not said} == set()
    assert (own["enabled"], own["told"], own["back"]) == ("ENABLED", True, True)
