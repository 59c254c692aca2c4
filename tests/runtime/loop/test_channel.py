"""Shared memory between loop and supervisor: order, loss counted, commands complete, grants readable."""

import os

from servod.formats.recording.record import FIELDS, CycleRecord
from servod.runtime.loop.channel import COMMAND_SLOTS, MAX_ARGUMENTS, RECORD_SLOTS, Channel
from servod.runtime.loop.commands import Command, Op
from servod.runtime.loop.realtime import Grant


def record(number: int) -> tuple[float, ...]:
    return tuple(number if f.kind == "q" else number / 2 for f in FIELDS)


def both_sides() -> tuple[Channel, Channel]:
    supervisor = Channel()
    return supervisor, Channel(os.dup(supervisor.fd))


def test_records_arrive_in_order_and_once():
    supervisor, loop = both_sides()
    for number in range(10):
        loop.write_record(record(number))
    assert [CycleRecord.unpack(r).cycle for r in supervisor.drain()] == list(range(10))
    assert supervisor.drain() == []
    assert supervisor.lost == 0


def test_a_hanging_supervisor_loses_the_oldest_and_knows_how_many():
    supervisor, loop = both_sides()
    total = RECORD_SLOTS + 100
    for number in range(total):
        loop.write_record(record(number))
    numbers = [CycleRecord.unpack(r).cycle for r in supervisor.drain()]
    assert numbers[-1] == total - 1
    assert numbers == list(range(numbers[0], total))
    assert supervisor.lost == numbers[0]


def test_commands_carry_all_their_arguments_and_a_full_queue_says_so():
    supervisor, loop = both_sides()
    arguments = tuple(float(i) for i in range(MAX_ARGUMENTS))
    assert supervisor.send(Command(7, Op.ACTIVATE, arguments))
    assert loop.next_command() == Command(7, Op.ACTIVATE, arguments)
    assert loop.next_command() is None
    taken = 0
    while supervisor.send(Command(taken, Op.HALT, ())):
        taken += 1
    assert 0 < taken < COMMAND_SLOTS
    assert supervisor.send(Command(99, Op.QUICK_STOP, ()))  # there is always room for a stop
    assert loop.next_command() == Command(0, Op.HALT, ())


def test_grants_and_beats_cross_over():
    supervisor, loop = both_sides()
    assert supervisor.grants() == []
    loop.publish_ready([Grant("sched_fifo", False, "no")])
    assert supervisor.grants() == [Grant("sched_fifo", False, "no")]
    before = loop.supervisor_beats()
    supervisor.beat()
    assert loop.supervisor_beats() == before + 1
