"""Frames that this master did not send and no node owed: each is a fault with a name, in 50 ms at the longest.

In virtual time, by a further participant of the bus. Before the watch existed, only SYNC, the command and the master's
heartbeat were seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from servod.client.stepped import SteppedSession
from servod.common.faults import FaultCode, faults_in
from servod.common.shipped import shipped
from servod.drivers.virtual.bus_faults import BusFault, FaultKind
from servod.drivers.virtual.world import SteppedWorld, VirtualAxisSettings
from servod.formats.config import load_config
from servod.formats.gains.gain_set import load_gains
from servod.formats.model.axis_model import load_axis_model
from servod.runtime.fieldbus.master.scan import scan
from servod.runtime.loop.axis_state import AxisState
from servod.runtime.loop.commands import Op, ReferenceKind
from tests.forked import forked

F = FaultCode
LONGEST_S = 0.05
BLAMES = {F.SECOND_MASTER, F.FOREIGN_SDO, F.FOREIGN_FEEDBACK, F.DUPLICATE_NODE}
#: The loop's own connection, amplifier, encoder.
PARTICIPANTS = (0, 1, 2)
#: Identifier, data, and the fault that it is.
KINDS = {
    "SYNC": (0x080, "", F.SECOND_MASTER),
    "SYNC with counter": (0x080, "07", F.SECOND_MASTER),
    "TIME": (0x100, "000000000000", F.SECOND_MASTER),
    "NMT start": (0x000, "0101", F.SECOND_MASTER),
    "NMT to all": (0x000, "8000", F.SECOND_MASTER),
    "NMT to a node of somebody else": (0x000, "0205", F.SECOND_MASTER),
    "LSS": (0x7E5, "0401000000000000", F.SECOND_MASTER),
    "LSS answer": (0x7E4, "4F00000000000000", F.SECOND_MASTER),
    "command": (0x201, "06000000", F.SECOND_MASTER),
    "second command PDO of the drive": (0x301, "0600", F.SECOND_MASTER),
    "PDO to the encoder": (0x502, "00", F.SECOND_MASTER),
    "heartbeat of the master": (0x77E, "05", F.SECOND_MASTER),
    "EMCY of the master": (0x0FE, "1023810000000000", F.SECOND_MASTER),
    "feedback of the drive": (0x181, "3706000000000000", F.FOREIGN_FEEDBACK),
    "short feedback of the drive": (0x181, "37", F.FOREIGN_FEEDBACK),
    "position": (0x282, "10000000", F.FOREIGN_FEEDBACK),
    "mode and error of the drive, too short": (0x281, "0A00", F.FOREIGN_FEEDBACK),
    "another mode of the drive": (0x281, "010000", F.FOREIGN_FEEDBACK),
    "alarms of the encoder without data": (0x182, "", F.FOREIGN_FEEDBACK),
    "an alarm of the encoder": (0x182, "0100", F.FOREIGN_FEEDBACK),
    "third PDO of the drive": (0x381, "0000", F.FOREIGN_FEEDBACK),
    "fourth PDO of the encoder": (0x482, "", F.FOREIGN_FEEDBACK),
    "SDO read": (0x601, "4000100000000000", F.FOREIGN_SDO),
    "SDO write": (0x601, "2B07600000000000", F.FOREIGN_SDO),
    "SDO abort": (0x602, "8000100000000408", F.FOREIGN_SDO),
    "SDO answer": (0x581, "4300100092010200", F.FOREIGN_SDO),
    "EMCY": (0x081, "1023810000000000", F.DRIVE_FAULT),
    "EMCY of the encoder": (0x082, "1023810000000000", F.ENCODER_ALARM),
    "boot-up of DS-301 V3": (0x081, "", F.DRIVE_RESET),
    "EMCY takes back": (0x081, "0000000000000000", F.DUPLICATE_NODE),
    "heartbeat of the drive": (0x701, "05", F.DUPLICATE_NODE),
    "heartbeat of the encoder": (0x702, "05", F.DUPLICATE_NODE),
    "heartbeat with a state that is none": (0x701, "01", F.DUPLICATE_NODE),
    "heartbeat with a state that is none, of the encoder": (0x702, "FE", F.DUPLICATE_NODE),
    "other heartbeat": (0x701, "7F", F.NODE_LEFT_OPERATIONAL),
    "boot-up": (0x702, "00", F.DRIVE_RESET),
}


GAINS = load_gains(shipped("gains/demo_pd.yaml"))
JOINT = load_axis_model(shipped("gains/axes/demo_joint.yaml"))
CONFIG = load_config(shipped("gains/config/virtual.yaml"))
#: Without the test of the wiring, which takes half a second, and tells nothing here.
CONFIG = CONFIG.model_copy(update={"wiring_proof": CONFIG.wiring_proof.model_copy(update={"enabled": False})})


@cache
def ready(does: str) -> SteppedSession:
    """One for all trials that are forks."""
    return axis_that(does)


def axis_that(does: str) -> SteppedSession:
    world = SteppedWorld(VirtualAxisSettings(queue_depth=1024), JOINT)
    axis = SteppedSession(CONFIG, world, GAINS.law.number, GAINS.pack())
    axis.run(0.5)  # eight heartbeats, by which the next is judged
    if does != "rests":
        axis.enable()
    if does == "moves":
        axis.send(Op.REFERENCE, [ReferenceKind.SINE, 0.2, 0.5, 60.0])
        axis.run(0.1)
    assert latched(axis) == set()
    return axis


def latched(axis: SteppedSession) -> set[FaultCode]:
    return {fault.code for fault in faults_in(axis.cycle.axis.latched)}


def hear_a_stranger(axis: SteppedSession, kind: str, after_us: int) -> bool:
    """Whether the frame is a fault in time, and a powered axis stops."""
    can_id, data, fault = KINDS[kind]
    stranger, powered = axis.world.connect(()), axis.cycle.axis.state.powered
    axis.clock.sleep_until(axis.clock.now_ns() + after_us * 1000)
    stranger.send(can_id, bytes.fromhex(data))
    axis.run(LONGEST_S)
    return fault in latched(axis) and not (powered and axis.cycle.axis.state == AxisState.ENABLED)


@pytest.mark.parametrize("phase_us", [50, 420, 940])
@pytest.mark.parametrize("does", ["rests", "holds", "moves"])
def test_each_foreign_frame_is_a_fault_with_its_name(does: str, phase_us: int) -> None:
    axis = ready(does)
    heard = {kind: forked(lambda k=kind: b"%d" % hear_a_stranger(axis, k, phase_us)) for kind in KINDS}
    assert heard == dict.fromkeys(KINDS, b"1")


@pytest.mark.parametrize("kind", ["heartbeat of the drive", "heartbeat of the encoder"])
def test_a_second_heartbeat_is_a_fault_wherever_it_comes_between_two(kind: str) -> None:
    axis = ready("rests")

    def heard(phase_ms: int) -> bytes:
        axis.run(phase_ms * 1e-3)
        return b"%d" % hear_a_stranger(axis, kind, 100)

    assert {ms: forked(lambda ms=ms: heard(ms)) for ms in range(0, 50, 5)} == dict.fromkeys(range(0, 50, 5), b"1")


@pytest.mark.parametrize(("can_id", "data"), [(0x281, "0A0000"), (0x182, "0000")])
@pytest.mark.parametrize("does", ["rests", "moves"])
def test_a_second_frame_of_every_tenth_sync_is_a_fault_wherever_it_comes(does: str, can_id: int, data: str) -> None:
    """Mode and error of the drive, alarms of the encoder, as they are: behind the node's own one copy may be CAN's."""
    axis = ready(does)

    def heard(phase_ms: int, copies: int) -> bytes:
        axis.run(phase_ms * 1e-3)
        stranger = axis.world.connect(())
        axis.clock.sleep_until(axis.clock.now_ns() + 100_000)
        for _ in range(copies):
            stranger.send(can_id, bytes.fromhex(data))
        axis.run(0.02)
        return b"%d" % (F.FOREIGN_FEEDBACK in latched(axis))

    alone, twice = ([forked(lambda ms=ms, n=n: heard(ms, n)) for ms in range(10)] for n in (1, 2))
    assert alone.count(b"1") >= 9
    assert twice == [b"1"] * 10


@pytest.mark.parametrize("node_id", [1, 2])
def test_an_error_that_somebody_else_told_of_leaves_nothing_to_take_back(node_id: int) -> None:
    """Its error register, which is asked meanwhile, knows of none."""
    axis = axis_that("rests")
    stranger = axis.world.connect(())
    stranger.send(0x080 + node_id, bytes.fromhex("1023810000000000"))
    axis.run(2.0)
    axis.enable(reset_fault=True)
    stranger.send(0x080 + node_id, bytes(8))
    axis.run(LONGEST_S)
    assert F.DUPLICATE_NODE in latched(axis)


STALLS = st.lists(
    st.tuples(st.integers(0, 60), st.integers(1, 100), st.sets(st.sampled_from(PARTICIPANTS), min_size=1)), max_size=12
)


def let_stall(axis: SteppedSession, stalls: Sequence[tuple[int, int, set[int]]]) -> None:
    """What the participants send comes late, all of it, in order: pairs of the time before and the length, in ms."""
    for gap_ms, length_ms, participants in stalls:
        axis.run(gap_ms * 1e-3)
        for participant in participants:
            axis.loop_bus.inject(BusFault(FaultKind.STUCK, amount=length_ms, participant=participant))
    axis.run(0.3)


@settings(max_examples=40, deadline=None, derandomize=True)
@given(stalls=STALLS)
def test_no_stall_of_the_bus_is_taken_for_somebody_else(stalls: list[tuple[int, int, set[int]]]) -> None:
    axis = ready("holds")

    def blamed() -> bytes:
        let_stall(axis, stalls)
        return " ".join(code.name for code in latched(axis) & BLAMES).encode()

    assert forked(blamed) == b""


@settings(max_examples=30, deadline=None, derandomize=True)
@given(stalls=STALLS, kind=st.sampled_from([k for k, (_, _, fault) in KINDS.items() if fault in BLAMES]))
def test_whoever_speaks_after_stalls_is_heard(stalls: list[tuple[int, int, set[int]]], kind: str) -> None:
    axis = ready("rests")

    def heard() -> bytes:
        let_stall(axis, stalls)
        axis.run(0.4)  # heartbeats again
        if F.NODE_LEFT_OPERATIONAL in latched(axis):
            return b"1"  # one that must be configured again is not at work, so that nobody is told from it
        return b"%d" % hear_a_stranger(axis, kind, 300)

    assert forked(heard) == b"1"


def test_of_feedback_that_was_lost_one_frame_is_owed_for_ever() -> None:
    axis = axis_that("rests")
    axis.loop_bus.inject(BusFault(FaultKind.DROP, 0x181, 5))
    axis.run(0.15)
    assert not hear_a_stranger(axis, "feedback of the drive", 420)
    assert hear_a_stranger(axis, "feedback of the drive", 420)


def test_node_a_cycle_behind_that_catches_up_is_nobody_else() -> None:
    """By a clock of its own it answers after the next SYNC for a while, and then in time again: two in one cycle."""
    axis = axis_that("rests")
    axis.loop_bus.inject(BusFault(FaultKind.DROP, 0x282, 1))  # the answer that comes a cycle later, as the last of many
    axis.run(0.3)
    late = axis.world.connect(())
    axis.clock.sleep_until(axis.clock.now_ns() + 420_000)
    late.send(0x282, bytes(4))
    axis.run(0.05)
    assert F.FOREIGN_FEEDBACK not in latched(axis)


def test_what_a_stall_held_up_is_not_given_up_at_the_first_answer_behind_it() -> None:
    """A node that stood still answers in time again before what it owes is through, at whatever cycle it was."""
    axis = ready("rests")

    def blamed(phase_ms: int) -> bytes:
        axis.run(phase_ms * 1e-3)
        for can_id in (0x181, 0x282):
            axis.loop_bus.inject(BusFault(FaultKind.DROP, can_id, 3))
        axis.run(5e-3)  # three without an answer, two with
        held_up = axis.world.connect(())
        axis.clock.sleep_until(axis.clock.now_ns() + 420_000)
        for counts in range(3):
            held_up.send(0x282, counts.to_bytes(4, "little"))
        axis.run(0.02)
        return b"%d" % (F.FOREIGN_FEEDBACK in latched(axis))

    assert {ms: forked(lambda ms=ms: blamed(ms)) for ms in range(100)} == dict.fromkeys(range(100), b"0")


def test_feedback_that_a_controller_repeats_is_not_foreign() -> None:
    """The transmitter did not see its frame acknowledged by all: CAN gives it again, at once, with the same data."""
    axis = axis_that("moves")
    axis.loop_bus.inject(BusFault(FaultKind.DUPLICATE, 0x181, 1))
    axis.loop_bus.inject(BusFault(FaultKind.DUPLICATE, 0x282, 1))
    axis.loop_bus.inject(BusFault(FaultKind.DUPLICATE, 0x281, 1))
    axis.loop_bus.inject(BusFault(FaultKind.DUPLICATE, 0x182, 1))
    axis.run(0.1)
    assert latched(axis) == set()


@pytest.mark.parametrize("every_ms", [20, 50, 99, 150])
def test_a_bus_that_loses_frames_all_the_while_does_not_let_foreign_ones_pass(every_ms: int) -> None:
    """What is lost is given up again and again, and not only behind a long row without a loss."""
    axis = ready("holds")

    def passed() -> bytes:
        for _ in range(3000 // every_ms):
            axis.loop_bus.inject(BusFault(FaultKind.DROP, 0x282, 1))
            axis.run(every_ms * 1e-3)
        return b"%d" % next(n for n in range(200) if hear_a_stranger_at_once(axis, n))

    assert int(forked(passed)) <= 1 + 100 // every_ms


def hear_a_stranger_at_once(axis: SteppedSession, count: int) -> bool:
    stranger = axis.world.connect(())
    axis.clock.sleep_until(axis.clock.now_ns() + 420_000)
    stranger.send(0x282, (1000 + count).to_bytes(4, "little"))
    axis.run(1e-3)
    return F.FOREIGN_FEEDBACK in latched(axis)


@pytest.mark.parametrize(("node", "can_id"), [(1, 0x181), (2, 0x282)])
@pytest.mark.parametrize("does", ["rests", "holds", "moves"])
def test_one_foreign_frame_in_a_stall_is_told_behind_it(does: str, node: int, can_id: int) -> None:
    """At rest, too, where the node's own frame that is then one too many looks like the one before it.

    However long it is: at some lengths the last frames of the stall and the first behind it come close together.
    """
    axis = ready(does)

    def heard(length_ms: int) -> bytes:
        axis.loop_bus.inject(BusFault(FaultKind.STUCK, amount=length_ms, participant=node))
        axis.run(1e-3)
        foreign = {0x181: "3706000000000000", 0x282: "00100000"}[can_id]
        stranger = axis.world.connect(())
        axis.clock.sleep_until(axis.clock.now_ns() + 420_000)
        stranger.send(can_id, bytes.fromhex(foreign))
        axis.run(length_ms * 1e-3 + LONGEST_S)
        return b"%d" % (F.FOREIGN_FEEDBACK in latched(axis))

    lengths_ms = range(2, 26)  # behind a longer one the feedback is stale, which is a fault already
    assert {ms: forked(lambda ms=ms: heard(ms)) for ms in lengths_ms} == dict.fromkeys(lengths_ms, b"1")


def test_a_frame_that_comes_twice_does_not_stand_for_the_other_nodes() -> None:
    """The cycle waits for one frame of each node, and not for as many frames as there are nodes."""
    axis = axis_that("moves")
    axis.loop_bus.inject(BusFault(FaultKind.DELAY, amount=200, participant=2))  # the copy comes before its frame
    axis.run(0.01)
    axis.clear()
    axis.loop_bus.inject(BusFault(FaultKind.DUPLICATE, 0x181, 40))
    axis.run(0.1)
    assert {record.encoder_age for record in axis.records} == {0}
    assert latched(axis) == set()


@pytest.mark.parametrize("ours", [True, False])
def test_a_scan_of_this_daemon_is_told_from_that_of_somebody_else(ours: bool) -> None:
    axis = axis_that("rests")
    bus = axis.world.connect()
    found = scan(axis.master.of_ours(bus) if ours else bus, axis.clock, lss=False)
    axis.master.poll()
    blamed = {(event.node_id, event.fault) for event in axis.master.events() if event.fault in BLAMES}
    assert [node.node_id for node in found] == [1, 2]
    assert blamed == (set() if ours else {(1, F.FOREIGN_SDO), (2, F.FOREIGN_SDO)})
