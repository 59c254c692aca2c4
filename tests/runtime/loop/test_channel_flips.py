"""Every bit of the shared memory bent once: disabled, enabled at rest and moving, with and without a command under way.

One process holds master, loop and virtual axis with a real channel between them, brings the axis to where it shall be,
and forks for each flip: all begin in the same state, and what they do is compared, row by row, with a twin without one.
A flip is either without any effect, or the fault CHANNEL_CORRUPT and no torque from that row on. In memory that nobody
reads the same bit of many bytes is bent at once.
"""

import datetime
import gc
import mmap
import os
import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple

import pytest

from servod.client.stepped import ChannelPort, SteppedSession
from servod.common.clock import Clock
from servod.common.faults import FAULTS, FaultCode
from servod.common.shipped import shipped
from servod.drivers.virtual.world import SteppedWorld, VirtualAxisSettings
from servod.formats.config import load_config
from servod.formats.gains.gain_set import load_gains
from servod.formats.model.axis_model import load_axis_model
from servod.formats.recording.record import FIELDS, RECORD, CycleRecord
from servod.runtime.loop import channel as module
from servod.runtime.loop.axis_state import AxisState
from servod.runtime.loop.channel import COMMAND_SLOTS
from servod.runtime.loop.commands import Op, ReferenceKind, Refusal
from servod.runtime.loop.realtime import Grant
from servod.runtime.loop.wiring.findings import WiringReport
from tests.forked import forked

CORRUPT = FAULTS[FaultCode.CHANNEL_CORRUPT].bit
#: What a flip may take until it is seen, two rounds of the supervisor; and until a stop is over.
SEEN_S, STOPPED_S = 0.045, 0.045
#: Cycles between the state and the flip, so that records are there which the supervisor has not read.
BEFORE = 7
#: Bytes of which the same bit is bent at once where nobody reads.
GROUP = 16_384


class _OneMemory:
    """In place of the module mmap: both sides on one mapping that a fork copies."""

    def __init__(self) -> None:
        self.memory: mmap.mmap | None = None

    def mmap(self, _fd: int, size: int) -> mmap.mmap:
        if self.memory is None:
            self.memory = mmap.mmap(-1, size, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
        return self.memory


class _Port(ChannelPort):
    """Keeps what the loop wrote."""

    def __init__(self, clock: Clock) -> None:
        super().__init__(clock)
        self.loop.publish_ready([Grant("sched_fifo", False, "no right")])
        assert self.supervisor.ready_ns is not None
        self.written: list[bytes] = []

    def write_record(self, values: Sequence[float]) -> None:
        self.written.append(RECORD.pack(*values))
        super().write_record(values)


class Axis(NamedTuple):
    """An axis in some state, and its channel."""

    session: SteppedSession
    port: _Port


def _disabled(_axis: SteppedSession) -> None:
    """It was enabled once: the ring holds the commands that did it."""


def _enabled(axis: SteppedSession) -> None:
    axis.enable()
    axis.run(0.1)


def _moving(axis: SteppedSession) -> None:
    """Along a table, at its fastest."""
    _enabled(axis)
    samples = [0.2 * (n / 4000.0) ** 2 * (3.0 - 2.0 * n / 4000.0) for n in range(4000)]
    axis.load_trajectory(samples)
    assert axis.send(Op.REFERENCE, [ReferenceKind.TABLE, len(samples), 0.0, 0.2]) == Refusal.DONE
    axis.run(1.5)


STATES: dict[str, Callable[[SteppedSession], None]] = {"disabled": _disabled, "enabled": _enabled, "moving": _moving}
#: Commands that may be under way, with arguments; a CONFIRM has that which the loop asks for.
UNDER_WAY: dict[Op, tuple[float, ...]] = {
    Op.ENABLE: (1.0, 0.0),
    Op.CONFIRM: (),
    Op.DISABLE: (),
    Op.QUICK_STOP: (),
    Op.HALT: (1.0,),
    Op.ACTIVATE: (1.0, 0.0, 3.0, 1.0, 0.1, 0.001),
    Op.REFERENCE: (ReferenceKind.SINE, 0.05, 0.5, 4.0),
    Op.SHUTDOWN: (),
    Op.NODE_EVENT: (float(FaultCode.NODE_HEARTBEAT_LOST),),
}


@pytest.fixture(params=STATES, scope="module")
def axis(request: pytest.FixtureRequest) -> Iterator[Axis]:
    """One for all tests, which do everything in forks."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "mmap", _OneMemory())
        patch.setattr(os, "getppid", lambda: 1)  # which a fork changes, and the death of the supervisor
        yield from _brought_to(STATES[request.param])


def _brought_to(state: Callable[[SteppedSession], None]) -> Iterator[Axis]:
    gains = load_gains(shipped("gains/demo_pd.yaml"))
    world = SteppedWorld(VirtualAxisSettings(), load_axis_model(shipped("gains/axes/demo_joint.yaml")))
    config = load_config(shipped("gains/config/virtual.yaml"))
    port = _Port(world.clock)
    session = SteppedSession(config, world, gains.law.number, gains.pack(), port)
    for _ in range(COMMAND_SLOTS // 4):  # every slot holds an old command
        session.enable()
        session.send(Op.DISABLE)
        session.run(config.limits.ramp_down_s + 0.3)
    state(session)
    gc.collect()
    gc.freeze()
    yield Axis(session, port)
    gc.unfreeze()
    session.close()


class Story(NamedTuple):
    """What the loop wrote from the flip on, and what came of it to the supervisor."""

    written: list[bytes]
    came: list[bytes]


def _tell(axis: Axis, flip: Callable[[], None], prepared: Op | None, under_way: Op | None) -> Story:
    """Go on for some cycles, then with a flip, and stop at last. `prepared` is what will be under way, or would be."""
    session, port = axis
    session.clear()
    port.written.clear()
    if prepared is Op.CONFIRM:
        port.send(Op.ENABLE, UNDER_WAY[Op.ENABLE])
    session.run(BEFORE * 1e-3)
    if under_way is not None:
        asked_for = float(CycleRecord.unpack(port.written[-1]).command_result)
        port.send(under_way, (asked_for,) if under_way is Op.CONFIRM else UNDER_WAY[under_way])
    flip()
    session.run(SEEN_S)
    port.send(Op.HALT, (0.0,))
    session.run(0.005)
    port.send(Op.QUICK_STOP, ())
    session.run(STOPPED_S)
    rows = bytes(port.rows)
    return Story(port.written, [rows[at : at + RECORD.size] for at in range(0, len(rows), RECORD.size)])


def _judge(story: Story, whole: Story, twin: Story) -> str:
    """ "same" or "fault"; anything else is wrong, and says what.

    `whole` is without a flip; `twin` also without the command under way, which a flip may only take away.
    """
    if story == whole:
        return "same"
    if not set(story.came) <= set(story.written):
        return "a record came that was not written"
    differs = next((n for n, (a, b) in enumerate(zip(story.written, twin.written, strict=True)) if a != b), None)
    if differs is None:
        return "records are missing without a fault"
    for number, row in enumerate(story.written[differs:], differs):
        record = CycleRecord.unpack(row)
        if not record.faults_latched & CORRUPT:
            return f"row {number} differs from the twin without the fault"
        if record.torque_nm != 0.0 or record.axis_state not in _STANDING:
            return f"row {number}: {AxisState(record.axis_state).name}, {record.torque_nm} N*m"
    return "fault" if AxisState(record.axis_state).stopped else "it never stops"


_STANDING = (AxisState.DISABLED, AxisState.FAULT, AxisState.QUICK_STOPPING)


#: Which flips are the sample's; a failure names its bit, so that it can be had again on any other day.
DAY = datetime.date.today().toordinal()


class Flips:
    """Flips from one state of an axis, each judged against the twin."""

    def __init__(self, axis: Axis, under_way: Op | None = None, share: int = 1) -> None:
        """One of `share` flips is made; which one, the day says."""
        self._axis, self._under_way = axis, under_way
        self._ahead, self._share = DAY % share, share
        self.seen: dict[str, int] = {}
        self._twin = self._without_flip(None)
        self._whole = self._without_flip(under_way)

    def bits(self, bits: Iterable[int]) -> None:
        """One by one."""
        for bit in bits:
            if self._due():
                self._look(f"bit {bit % 64} of word {bit // 64}", bit // 8, bytes((1 << bit % 8,)))

    def group(self, at: int, size: int, bit: int) -> None:
        """The same bit of many bytes."""
        if self._due():
            self._look(f"bits {bit} of bytes {at} to {at + size}", at, bytes((1 << bit,)) * size)

    def words(self, first: int, count: int) -> None:
        """All bits of some words."""
        self.bits(range(64 * first, 64 * (first + count)))

    def _due(self) -> bool:
        self._ahead = (self._ahead + 1) % self._share
        return self._ahead == 0

    def _look(self, name: str, at: int, mask: bytes) -> None:
        memory, under_way = self._axis.port.loop._view, self._under_way

        def flip() -> None:
            now = int.from_bytes(memory[at : at + len(mask)], "little")
            memory[at : at + len(mask)] = (now ^ int.from_bytes(mask, "little")).to_bytes(len(mask), "little")

        def told() -> Story:
            return _tell(self._axis, flip, under_way, under_way)

        verdict = forked(lambda: _judge(told(), self._whole, self._twin).encode()).decode()
        assert verdict in ("same", "fault"), f"{name}: {verdict}"
        self.seen[verdict] = self.seen.get(verdict, 0) + 1

    def _without_flip(self, under_way: Op | None) -> Story:
        def packed() -> bytes:
            story = _tell(self._axis, lambda: None, self._under_way, under_way)
            return b"".join(story.written + story.came)

        rows = [row for (row,) in struct.iter_unpack(f"{RECORD.size}s", forked(packed))]
        return Story(rows[: len(rows) // 2], rows[len(rows) // 2 :])  # all that was written came


#: Of how many flips one is made: the sample is another one each day, until all were made.
SHARES = [pytest.param(61, id="sample"), pytest.param(1, id="all", marks=[pytest.mark.long, pytest.mark.timeout(3600)])]
ROW_WORDS, BLOCK_WORDS = len(FIELDS) + 2, module._BLOCK_SAMPLES + 2


@pytest.mark.parametrize("share", SHARES)
def test_bits_in_front_of_the_rings_and_of_waiting_slots(axis: Axis, share: int) -> None:
    loop, flips = axis.port.loop, Flips(axis, share=share)
    flips.words(0, 2)
    flips.words(loop._grants.index(1), 8)
    flips.words(loop._proofs.index(1), len(WiringReport._fields) + 2)
    for ahead in range(COMMAND_SLOTS):
        flips.words(loop._commands.index(loop._next_command + ahead), 7 if ahead < 2 else 1)
    assert flips.seen.keys() == {"same", "fault"} or (share > 1 and flips.seen)


@pytest.mark.parametrize("share", SHARES)
def test_bits_of_records(axis: Axis, share: int) -> None:
    loop, flips = axis.port.loop, Flips(axis, share=share)
    newest = loop._row + BEFORE
    for number in (newest, newest + 1):
        flips.words(loop._records.index(number), ROW_WORDS)
    assert flips.seen.keys() == {"same", "fault"} or (share > 1 and flips.seen)


@pytest.mark.parametrize("axis", ["moving"], indirect=True)
@pytest.mark.parametrize("share", SHARES)
def test_bits_of_a_table(axis: Axis, share: int) -> None:
    """Of the blocks that were read and those that come, the motion is in the middle of one."""
    loop, flips = axis.port.loop, Flips(axis, share=share)
    read = max(loop.trajectory._blocks)
    for block in range(read, read + 4):
        words = BLOCK_WORDS if block == read + 2 else 2  # which is checked next
        flips.words(loop._blocks.index(loop.trajectory._table * module._BLOCKS + block), words)
    assert flips.seen.keys() == {"same", "fault"} or (share > 1 and flips.seen)


@pytest.mark.parametrize("under_way", UNDER_WAY)
@pytest.mark.parametrize("share", SHARES)
def test_bits_of_a_command_under_way(axis: Axis, under_way: Op, share: int) -> None:
    flips = Flips(axis, under_way, share)
    number = axis.port.supervisor._sent + (2 if under_way is Op.CONFIRM else 1)
    flips.words(axis.port.loop._commands.index(number), 6 + max(1, len(UNDER_WAY[under_way])))
    assert flips.seen["fault"] >= (6 if share == 1 else 1)


@pytest.mark.parametrize("share", SHARES)
def test_bits_of_all_the_memory(axis: Axis, share: int) -> None:
    flips, size = Flips(axis, share=share), len(axis.port.loop._view)
    for at in range(0, size, GROUP):
        for bit in range(8):
            flips.group(at, min(GROUP, size - at), bit)
    assert "same" in flips.seen


@pytest.mark.parametrize("axis", ["moving"], indirect=True)
def test_channel_without_checksums_is_found_out(axis: Axis, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "crc32", lambda _data, _number: 0)
    flips = Flips(axis, Op.ACTIVATE)
    slot = axis.port.loop._commands.index(axis.port.supervisor._sent + 1)
    with pytest.raises(AssertionError, match="without the fault"):
        flips.words(slot + 6, 6)
