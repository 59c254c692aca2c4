"""Shared memory between loop and supervisor: order, loss counted, commands complete, nothing bent taken."""

import os
import struct

import pytest

from servod.common.units import NS_PER_S
from servod.formats.recording.record import FIELDS, CycleRecord
from servod.runtime.loop.channel import _BLOCKS, COMMAND_SLOTS, MAX_ARGUMENTS, RECORD_SLOTS, Channel
from servod.runtime.loop.commands import Command, Op, ReferenceKind
from servod.runtime.loop.realtime import Grant
from servod.runtime.loop.wiring.findings import WiringReport


class Hand:
    """A clock that stands until somebody moves it."""

    ns = 0

    def now_ns(self) -> int:
        return self.ns

    def sleep_until(self, deadline_ns: int) -> None:
        self.ns = deadline_ns


def record(number: int) -> tuple[float, ...]:
    return tuple(number if f.kind == "q" else number / 2 for f in FIELDS)


def both_sides() -> tuple[Channel, Channel]:
    clock = Hand()
    supervisor = Channel(clock=clock)
    return supervisor, Channel(os.dup(supervisor.fd), clock)


def flip(channel: Channel, bit: int) -> None:
    """Of the segment, as a cosmic ray would."""
    at, shift = divmod(bit, 8)
    (byte,) = os.pread(channel.fd, 1, at)
    os.pwrite(channel.fd, bytes((byte ^ 1 << shift,)), at)


def places(channel: Channel, data: bytes) -> int:
    """The one byte of the segment at which `data` begins."""
    whole = os.pread(channel.fd, os.fstat(channel.fd).st_size, 0)
    assert whole.count(data) == 1
    return whole.index(data)


def test_records_arrive_in_order_and_once():
    supervisor, loop = both_sides()
    for number in range(10):
        loop.write_record(record(number))
    assert [CycleRecord.unpack(r).cycle for r in supervisor.drain()] == list(range(10))
    assert supervisor.drain() == []
    assert supervisor.lost == 0


@pytest.mark.parametrize("more", [-1, 0, 1, 100, RECORD_SLOTS, 2 * RECORD_SLOTS + 5])
def test_a_hanging_supervisor_loses_the_oldest_and_knows_how_many(more):
    supervisor, loop = both_sides()
    total = RECORD_SLOTS + more
    for number in range(total):
        loop.write_record(record(number))
    numbers = [CycleRecord.unpack(r).cycle for r in supervisor.drain()]
    assert numbers[-1] == total - 1
    assert numbers == list(range(numbers[0], total))
    assert supervisor.lost == numbers[0] <= max(0, more + 1)
    assert not supervisor.take_corrupt()


def test_commands_carry_all_their_arguments_and_a_full_queue_says_so():
    supervisor, loop = both_sides()
    arguments = tuple(float(i) for i in range(MAX_ARGUMENTS))
    assert supervisor.send(Op.ACTIVATE, arguments) == 1
    assert loop.next_command() == Command(1, Op.ACTIVATE, arguments)
    assert loop.next_command() is None
    taken = 0
    while supervisor.send(Op.HALT):
        taken += 1
    assert 0 < taken < COMMAND_SLOTS
    assert supervisor.send(Op.QUICK_STOP)  # there is always room for a stop
    assert loop.next_command() == Command(2, Op.HALT, ())


def test_grants_and_beats_cross_over():
    supervisor, loop = both_sides()
    assert supervisor.grants() == []
    assert supervisor.ready_ns is None
    loop.publish_ready([Grant("sched_fifo", False, "no")])
    assert supervisor.ready_ns is not None
    assert supervisor.grants() == [Grant("sched_fifo", False, "no")]
    before = loop.supervisor_beats()
    supervisor.beat()
    assert loop.supervisor_beats() != before


def test_table_is_read_as_it_was_written_and_the_next_one_instead_of_it():
    supervisor, loop = both_sides()
    for samples in ([0.1 * n for n in range(1000)], [0.2 * n for n in range(63)]):
        supervisor.write_trajectory(samples)
        supervisor.send(Op.REFERENCE, (ReferenceKind.TABLE, len(samples), 0.0, 1.0))
        assert loop.next_command() is not None
        assert [loop.trajectory[n] for n in range(len(loop.trajectory))] == samples
        assert loop.next_command() is None


@pytest.mark.parametrize("op", [Op.ENABLE, Op.CONFIRM, Op.HALT, Op.ACTIVATE, Op.REFERENCE, Op.DISABLE, Op.QUICK_STOP])
@pytest.mark.parametrize("age_ns", [NS_PER_S, NS_PER_S + 1, -1])
def test_what_gives_motion_is_refused_when_it_comes_too_late_and_a_stop_never_is(op, age_ns):
    supervisor, loop = both_sides()
    Hand.ns = 10 * NS_PER_S
    number = supervisor.send(op, (1.0,))
    Hand.ns += age_ns
    command = loop.next_command()
    assert command is not None
    assert command.seq == number
    taken = op in (Op.DISABLE, Op.QUICK_STOP) or age_ns == NS_PER_S
    assert command.op == (op if taken else Op.CORRUPT)


def taken_commands(loop: Channel, cycles: int = 10) -> list[int]:
    return [c.op for c in (loop.next_command() for _ in range(cycles)) if c is not None]


@pytest.mark.parametrize("before", [0, 1, COMMAND_SLOTS - 1, COMMAND_SLOTS, 40])
def test_no_bit_of_a_command_makes_it_another_one_and_a_stop_behind_it_comes(before):
    """Bits of the ticket, length, stamp, kind, table and arguments of a command that the loop has not taken yet."""
    at = 0
    for bit in range(64 * 7):
        supervisor, loop = both_sides()
        for _ in range(before):
            supervisor.send(Op.HALT, (0.0,))
            loop.next_command()
        mark = 1234.5
        supervisor.send(Op.HALT, (mark,))
        at = places(supervisor, struct.pack("<d", mark)) if bit == 0 else at  # of each pair of sides the same
        flip(supervisor, 8 * (at - 48) + bit)
        assert taken_commands(loop) == [Op.CORRUPT]
        supervisor.send(Op.QUICK_STOP)
        supervisor.send(Op.HALT, (2.0,))
        assert taken_commands(loop) == [Op.QUICK_STOP, Op.HALT]
        loop.close()
        supervisor.close()


@pytest.mark.parametrize("before", [0, 20])
def test_slot_that_waits_for_its_command_may_be_bent_and_still_takes_it(before):
    for bit in range(64):
        supervisor, loop = both_sides()
        for number in range(before):
            supervisor.send(Op.HALT, (float(number),))
            loop.next_command()
        at = 8 * loop._commands.index(before + 1)
        flip(supervisor, 8 * at + bit)
        told = taken_commands(loop)
        assert told == [Op.CORRUPT]
        assert taken_commands(loop) == []  # once
        supervisor.send(Op.HALT, (1.0,))
        assert taken_commands(loop) == [Op.HALT]
        loop.close()
        supervisor.close()


def test_ticket_that_is_seen_before_its_data_is_waited_for():
    """What a processor without strong order may show for a moment."""
    supervisor, loop = both_sides()
    supervisor.send(Op.HALT, (1234.5,))
    at = places(supervisor, struct.pack("<d", 1234.5))
    os.pwrite(supervisor.fd, bytes(8), at)
    assert loop.next_command() is None
    assert loop.next_command() is None
    os.pwrite(supervisor.fd, struct.pack("<d", 1234.5), at)
    command = loop.next_command()
    assert command is not None
    assert command.arguments == (1234.5,)


@pytest.mark.parametrize("before", [3, RECORD_SLOTS + 3])
def test_no_bit_of_a_record_makes_it_another_one(before):
    supervisor, loop = both_sides()
    for number in range(before):
        loop.write_record(record(number))
        if number % 1000 == 0:
            supervisor.drain()
    supervisor.drain()
    for bit in range(64 * (len(FIELDS) + 2)):
        at = 8 * loop._records.index(loop._row + 1)
        loop.write_record(record(7))
        flip(supervisor, 8 * at + bit)
        assert supervisor.drain() == []
        loop.write_record(record(8))
        lost = supervisor.lost
        rows = supervisor.drain() + supervisor.drain()
        assert [CycleRecord.unpack(row).cycle for row in rows] == [8]
        assert supervisor.lost == lost + 1
        assert supervisor.take_corrupt()


def test_no_bit_of_a_wiring_test_makes_it_another_one():
    supervisor, loop = both_sides()
    one, two = (WiringReport._make([value] * len(WiringReport._fields)) for value in (1.0, 2.0))
    loop.write_proof(one)
    assert supervisor.proofs() == (1, one)
    at = 8 * loop._proofs.index(0)
    for bit in range(64 * (len(one) + 2)):
        loop.write_proof(two)
        flip(supervisor, 8 * at + bit)
        before = supervisor.proofs()
        supervisor.proofs()
        assert before == supervisor.proofs()
        assert supervisor.take_corrupt()
        assert not supervisor.take_corrupt()
        loop.write_proof(one)
        assert supervisor.proofs()[1] == one


def test_no_bit_of_both_counters_is_believed():
    supervisor, loop = both_sides()
    for _ in range(3):
        supervisor.send(Op.HALT)
        loop.next_command()
    supervisor.beat()
    assert supervisor._commands_taken() == 3
    beats = loop.supervisor_beats()
    for bit in range(128):
        flip(supervisor, bit)
        assert loop.supervisor_beats() == beats
        assert supervisor._commands_taken() == 3
        assert supervisor.take_corrupt() == (bit < 64)
        flip(supervisor, bit)


def test_bent_table_is_told_a_block_ahead_and_is_no_number():
    supervisor, loop = both_sides()
    samples = [0.001 * n for n in range(256)]
    for bit in range(64 * 66):
        supervisor.write_trajectory(samples)
        supervisor.send(Op.REFERENCE, (ReferenceKind.TABLE, len(samples), 0.0, 1.0))
        assert taken_commands(loop) == [Op.REFERENCE]
        number = loop.trajectory._table * _BLOCKS + 2
        flip(supervisor, 64 * loop._blocks.index(number) + bit)
        assert [loop.trajectory[n] for n in range(64)] == samples[:64]
        assert loop.next_command() is None
        assert loop.trajectory[64] == samples[64]
        assert taken_commands(loop) == [Op.CORRUPT]
        assert loop.trajectory[128] != loop.trajectory[128]
