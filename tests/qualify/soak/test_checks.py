"""The checkers of a soak, each with what it must find: rows of a real session, bent in one place."""

from __future__ import annotations

import os
import subprocess
import sys
import time

import numpy as np
import pytest

from servod.client.stepped import SteppedSession
from servod.common.faults import FAULTS, FaultCode
from servod.common.shipped import shipped
from servod.drivers.virtual.world import SteppedWorld, VirtualAxisSettings
from servod.formats.config import load_config
from servod.formats.gains.gain_set import load_gains
from servod.formats.model.axis_model import load_axis_model
from servod.kernels.laws import LAWS
from servod.lab.recordings.recording import Rows, rows_of
from servod.qualify.faults.judge import ReactionTimes
from servod.qualify.soak.drive import SAMPLE_ROW, DriveCheck, check_reaction, reaction_in
from servod.qualify.soak.kinds import KINDS, fault_bits
from servod.qualify.soak.memory import Growth, Memory
from servod.qualify.soak.rows import RowCheck, run_lengths
from servod.qualify.soak.starvation import STARVED_CYCLE, STARVED_SUPERVISOR, ExcusedFaults, Starvation
from servod.qualify.soak.syncs import SyncCheck, SyncListener
from servod.qualify.soak.tally import FaultTally, Findings, Wrong
from servod.runtime.fieldbus.devices import DriveState
from servod.runtime.loop.axis_state import AxisState

PERIOD_NS = 1_000_000
LIMIT_NM = 0.3


@pytest.fixture(scope="module")
def recorded() -> tuple[bytes, list[int]]:
    """Rows of an axis that is brought up, enabled and held, and the SYNC frames that were on the bus."""
    world = SteppedWorld(VirtualAxisSettings(), load_axis_model(shipped("gains/axes/demo_joint.yaml")))
    listener, gains = SyncListener(world.hub), load_gains(shipped("gains/demo_pd.yaml"))
    config = load_config(shipped("gains/config/virtual.yaml"))
    session = SteppedSession(config, world, LAWS[gains.law.name].number, gains.pack())
    session.run(0.1)
    session.enable()
    session.run(0.2)
    session.close()
    return session.raw, listener.take()


@pytest.fixture
def rows(recorded: tuple[bytes, list[int]]) -> Rows:
    return rows_of(bytearray(recorded[0]))


def found_in(*batches: Rows, explained: int = 0) -> dict[Wrong, int]:
    """What the row check finds in batches, one after the other."""
    findings = Findings()
    check = RowCheck(PERIOD_NS, LIMIT_NM, findings)
    for batch in batches:
        check.check(batch, explained)
    return dict(findings.counts)


def test_sound_rows_are_sound_in_any_batches(rows: Rows) -> None:
    assert found_in(rows) == found_in(rows[:7], rows[7:8], rows[8:8], rows[8:]) == {}


@pytest.mark.parametrize("place", [0, 1, 50])
def test_a_lost_row_is_found(rows: Rows, place: int) -> None:
    assert found_in(np.delete(rows, place)) == {Wrong.LOST_ROW: 1}
    assert found_in(rows[:60], rows[63:]) == {Wrong.LOST_ROW: 3}


def test_a_row_that_comes_twice_is_found(rows: Rows) -> None:
    assert found_in(rows[:60], rows[59:]) == {Wrong.DOUBLE_ROW: 1}


def test_a_period_that_was_skipped_and_says_so_is_no_lost_row(rows: Rows) -> None:
    later = rows[50:]
    later["missed"] += 1
    assert found_in(rows[:49], later) == {}


def test_a_clock_that_drifts_is_found(rows: Rows) -> None:
    rows["time_ns"][40:] += 1
    assert found_in(rows) == {Wrong.TIME: len(rows) - 40}


@pytest.mark.parametrize(
    ("name", "value", "wrong"),
    [
        ("position_rad", np.nan, Wrong.NOT_FINITE),
        ("friction_state", np.inf, Wrong.NOT_FINITE),
        ("torque_nm", 0.30001, Wrong.LIMIT),
        ("faults", FAULTS[FaultCode.ENCODER_ALARM].bit, Wrong.UNEXPLAINED),
        ("faults_latched", FAULTS[FaultCode.ENCODER_ALARM].bit, Wrong.UNEXPLAINED),
    ],
)
def test_a_bent_value_is_found(rows: Rows, name: str, value: float, wrong: Wrong) -> None:
    rows[name][-1] = value
    assert found_in(rows) == {wrong: 1}


def test_a_fault_that_the_schedule_explains_is_none(rows: Rows) -> None:
    bit = FAULTS[FaultCode.ENCODER_ALARM].bit
    rows["faults_latched"][-5:] = bit
    assert found_in(rows, explained=bit) == {}


def test_torque_of_an_axis_that_is_not_controlled_is_found(rows: Rows) -> None:
    assert rows["axis_state"][0] == AxisState.DISABLED
    rows["torque_nm"][0] = 0.001
    assert found_in(rows) == {Wrong.TORQUE: 1}


def test_a_drive_that_stays_where_the_axis_is_not_is_found_once(rows: Rows) -> None:
    rows["drive_state"][-20:-16] = DriveState.SWITCHED_ON
    assert found_in(rows) == {}  # an answer takes its time
    rows["drive_state"][-20:-10] = DriveState.SWITCHED_ON
    assert found_in(rows) == found_in(rows[:-15], rows[-15:]) == {Wrong.STATE: 1}


def test_run_lengths_go_on_across_batches() -> None:
    flags = np.array([True, True, False, True])
    assert run_lengths(flags, 3).tolist() == [4, 5, 0, 1]


@pytest.mark.parametrize("heard", [slice(1, None), slice(None, -1)])
def test_a_sync_that_the_listener_misses_is_found(recorded: tuple[bytes, list[int]], heard: slice) -> None:
    findings = Findings()
    check = SyncCheck(PERIOD_NS, findings)
    rows = rows_of(recorded[0])
    check.check(rows, recorded[1], False)
    assert not findings.counts and check.syncs == len(rows)
    check.check(rows, recorded[1][heard], False)
    assert findings.counts == {Wrong.SYNC: 1}


def test_a_sync_without_a_row_and_a_second_one_are_found(recorded: tuple[bytes, list[int]]) -> None:
    findings, rows = Findings(), rows_of(recorded[0])
    check = SyncCheck(PERIOD_NS, findings)
    check.check(rows[1:], recorded[1], False)
    assert findings.counts == {Wrong.SYNC: 1}
    check.check(rows, sorted([*recorded[1], recorded[1][5] + 1000]), False)
    assert findings.counts == {Wrong.SYNC: 2}
    check.check(rows[:0], recorded[1][:1], False)
    assert findings.counts == {Wrong.SYNC: 3}


def drive_samples(states: list[DriveState], torques_nm: list[float]) -> np.ndarray:
    """Samples of a drive, one a millisecond."""
    samples = np.zeros(len(states), dtype=SAMPLE_ROW)
    samples["time_ns"], samples["state"], samples["torque_nm"] = np.arange(len(states)) * PERIOD_NS, states, torques_nm
    return samples


def test_torque_of_a_drive_that_is_off_is_found() -> None:
    on, off = DriveState.OPERATION_ENABLED, DriveState.SWITCH_ON_DISABLED
    for states, torques_nm, wrong in (
        ([on, off], [0.1, 0.0], {}),
        ([on, off], [0.1, 0.1], {Wrong.TORQUE: 1}),
        ([on, on], [0.1, -0.31], {Wrong.LIMIT: 1}),
    ):
        findings = Findings()
        DriveCheck(LIMIT_NM, findings).check(drive_samples(states, torques_nm), 0)
        assert findings.counts == wrong


def test_samples_that_nobody_read_are_found_once() -> None:
    findings = Findings()
    check = DriveCheck(LIMIT_NM, findings)
    for lost in (0, 3, 3):
        check.check(drive_samples([], []), lost)
    assert findings.counts == {Wrong.RECORDER: 1}


def test_reaction_times_are_those_of_the_drive() -> None:
    on, off = DriveState.OPERATION_ENABLED, DriveState.SWITCH_ON_DISABLED
    samples = drive_samples([on, on, DriveState.QUICK_STOP_ACTIVE, off], [0.1, 0.1, 0.1, 0.0])
    assert reaction_in(samples, PERIOD_NS) == ReactionTimes(1.0, 2.0)
    assert reaction_in(samples[:-1], PERIOD_NS) == ReactionTimes(1.0, None)


@pytest.mark.parametrize(
    ("kb_per_h", "hours", "growth"),
    [(0.0, 1.0, Growth.FLAT), (5000.0, 2.0, Growth.GROWS), (0.0, 0.01, Growth.TOO_SHORT), (8e4, 0.1, Growth.TOO_SHORT)],
)
def test_a_leak_is_told_from_the_allocator_breathing(kb_per_h: float, hours: float, growth: Growth) -> None:
    chance, memory = np.random.default_rng(1), Memory()
    for hour in np.linspace(0.0, hours, 5000):
        warming_kb = 20_000.0 * (1.0 - np.exp(-hour / (0.05 * hours)))
        memory.add(hour * 3600.0, 1e5 + warming_kb + kb_per_h * hour + chance.normal(0.0, 300.0), 8)
    assert memory.slope().growth is growth
    assert len(memory.curve) <= 2048 and not memory.descriptors_grow()


def test_descriptors_that_are_not_closed_are_found() -> None:
    memory = Memory()
    for number in range(100):
        memory.add(float(number), 1e5, 8 + number // 10)
    assert memory.descriptors_grow()


def test_a_fault_is_explained_in_its_time_and_no_longer() -> None:
    explained = ExcusedFaults(always=1)
    explained.add(10, 2, 20)
    explained.add(15, 4)
    assert explained.at(np.array([9, 10, 20, 21])).tolist() == [1, 3, 7, 5]
    explained.end(30)
    explained.forget(21)
    assert explained.at(np.array([10, 30, 31])).tolist() == [1, 5, 1]


def test_a_process_that_got_no_turn_was_starved() -> None:
    begun_ns, cpus = time.monotonic_ns(), os.sched_getaffinity(0)
    starvation, one = Starvation(begun_ns), {min(cpus)}
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(3)]
    try:
        for process in busy:
            os.sched_setaffinity(process.pid, one)
        time.sleep(0.5)
        starvation.look({busy[0].pid: STARVED_CYCLE, busy[1].pid: STARVED_SUPERVISOR}, time.monotonic_ns())
    finally:
        for process in busy:
            process.kill()
            process.wait()
    assert starvation.explained.at(np.array([begun_ns]))[0] == fault_bits(STARVED_CYCLE | STARVED_SUPERVISOR)


def test_short_waits_of_many_processes_starve_none(monkeypatch: pytest.MonkeyPatch) -> None:
    waited_ms = {1: 0, 2: 0, 3: 0}
    monkeypatch.setattr("servod.qualify.soak.starvation.waited_ns", lambda pid: waited_ms[pid] * 1_000_000)
    monkeypatch.setattr("servod.qualify.soak.starvation.stolen_ns", lambda: 0)
    starvation, watched = Starvation(0), {1: STARVED_CYCLE, 2: STARVED_CYCLE, 3: STARVED_SUPERVISOR}
    waited_ms.update({1: 20, 2: 20, 3: 20})
    assert starvation.waited_ms(watched) == 60.0 and not starvation.is_starved(watched)
    starvation.look(watched, 10)
    waited_ms[3] += 26  # a piece of its own: only what the supervisor's waiting may cause
    starvation.look(watched, 20)
    late = frozenset({FaultCode.DEADLINE_LATE})  # told of a single period, and nothing follows
    assert starvation.explained.at(np.array([5, 15])).tolist() == [
        fault_bits(late),
        fault_bits(late | STARVED_SUPERVISOR),
    ]


def test_what_belongs_to_the_bound_is_told_with_it() -> None:
    kind, findings = next(k for k in KINDS if k.name == "encoder cut off"), Findings()
    assert not check_reaction(kind, ReactionTimes(109.0, 359.0), 0, FaultTally(), findings, 60.0)
    assert check_reaction(kind, ReactionTimes(115.0, 359.0), 0, FaultTally(), findings, 60.0, 10.0)
    assert not findings.counts
    check_reaction(kind, ReactionTimes(111.0, 359.0), 0, FaultTally(), findings, 60.0)
    assert findings.anomalies[0].text == "encoder cut off: command left after 111 ms, 110 ms allowed"
