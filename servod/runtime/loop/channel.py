"""Shared memory between supervisor and loop: cycle records out, commands in, one writer and one reader for each.

Neither side believes what it reads. Messages are numbered without a gap, and each stands in the slot of its number
behind a ticket: one aligned word of number and CRC-32 over number, length and data. The writer fills the slot and
stores the ticket last; the reader knows by itself which number comes next, copies the slot, and checks the copy. No
word says how much there is to read, so none can make old messages new ones. What is bent, repeated, out of order or (of
commands that give motion) too old is FaultCode.CHANNEL_CORRUPT, and nothing of it is used. Nobody waits for the other.

Memory order: CPython has no barriers, and on ARM the ticket may be seen before its data. The CRC then does not fit, and
the reader looks again in its next round, which is far longer than a store is on its way: what stays so is bent.
"""

from __future__ import annotations

import json
import math
import mmap
import os
import struct
from collections.abc import Callable, Sequence
from zlib import crc32

from servod.common.clock import Clock, WallClock
from servod.common.units import NS_PER_S
from servod.formats.recording.record import RECORD
from servod.runtime.loop.commands import Command, Op, ReferenceKind
from servod.runtime.loop.realtime import Grant
from servod.runtime.loop.wiring.findings import WiringReport

RECORD_SLOTS = 8192  # eight seconds at 1 kHz for a supervisor that hangs
COMMAND_SLOTS = 16
#: How far each kind of command may fill the queue: whoever floods it leaves room for a stop, and that for what the
#: supervisor itself has to say.
_COMMON_SLOTS = COMMAND_SLOTS // 2
_OPEN_SLOTS: dict[int, int] = {
    Op.DISABLE: COMMAND_SLOTS - 6,
    Op.QUICK_STOP: COMMAND_SLOTS - 4,
    Op.NODE_EVENT: COMMAND_SLOTS,
    Op.SHUTDOWN: COMMAND_SLOTS,
}
MAX_ARGUMENTS = 2045
TRAJECTORY_SAMPLES = 300_000  # five minutes at 1 kHz
#: A command older than this is corrupt, but for stops and node events, which are never too old: its client has given
#: up waiting by then, or soon will.
OLDEST_COMMAND_NS = NS_PER_S
_NEVER_TOO_OLD = frozenset({Op.DISABLE, Op.QUICK_STOP, Op.SHUTDOWN, Op.NODE_EVENT})
#: Cycles in which a ticket may be there before its data.
_TORN_CYCLES = 3

#: The two words in front of the slots: counters.
_TAKEN, _BEATS = 0, 1
_SLOTS_AT = 4096
_LOW = 0xFFFF_FFFF
_LENGTH = struct.Struct("<q")  # in front of all data, itself included
_ROW = struct.Struct("<q" + RECORD.format.removeprefix("<"))
_MESSAGE = struct.Struct("<qqqqq")  # length, sent [ns], op, number and samples of the table in the trajectory area
_PROOF = struct.Struct(f"<q{len(WiringReport._fields)}d")
_BLOCK_SAMPLES = 64  # of a table: one CRC each
_TABLES = (ReferenceKind.TABLE, ReferenceKind.EXCITE)
_BLOCKS = -(-TRAJECTORY_SAMPLES // _BLOCK_SAMPLES)


class _Slots:
    """A row of slots for numbered messages, the first of which is number 1; either side has its own."""

    def __init__(self, view: memoryview, at: int, count: int, capacity: int) -> None:
        """`count` slots for up to `capacity` bytes from byte `at` on, both multiples of eight."""
        self.end = at + count * (capacity + 8)
        self._view, self._at, self._count, self._capacity = view, at, count, capacity
        self._words = view.cast("Q")

    def release(self) -> None:
        """Let the mapping go."""
        self._words.release()

    def write(self, number: int, data: bytes) -> None:
        """Fill the slot of `number` with `data`, which begins with its own length; the ticket comes last."""
        at = self._at + number % self._count * (self._capacity + 8)
        self._view[at + 8 : at + 8 + len(data)] = data
        number &= _LOW
        self._words[at >> 3] = number << 32 | crc32(data, number)

    def index(self, number: int) -> int:
        """Where the ticket of `number` will stand, in words of the mapping."""
        return (self._at + number % self._count * (self._capacity + 8)) >> 3

    def ticket(self, number: int) -> int:
        """What stands there now."""
        return self._words[self.index(number)]

    def read(self, number: int) -> bytes | None:
        """The data of message `number`; None where something else stands in its slot, or it is bent."""
        index, low = self.index(number), number & _LOW
        ticket, length = self._words[index], self._words[index + 1]
        if ticket >> 32 != low or not _LENGTH.size <= length <= self._capacity:
            return None
        data = bytes(self._view[index * 8 + 8 : index * 8 + 8 + length])  # checked is the copy, and only that is used
        return data if crc32(data, low) == ticket & _LOW else None


class SharedTable:
    """The samples of a table motion as the loop reads them: block by block, each copied and checked before its use.

    With each block the next is checked, so that one that is bent is a fault before the motion comes to it. Its samples
    are not a number, which neither the loop's commands nor its limits let pass.
    """

    def __init__(self, blocks: _Slots, on_bent: Callable[[], None]) -> None:
        self._slots, self._on_bent = blocks, on_bent
        self._table = self._samples = 0
        self._blocks: dict[int, tuple[float, ...]] = {}  # that are read
        self._ahead: dict[int, tuple[float, ...]] = {}  # and that come next

    def begin(self, table: int, samples: int) -> None:
        """From now on the area is read as table number `table`."""
        self._table, self._samples = table, samples
        self._blocks, self._ahead = {}, {}

    def __len__(self) -> int:
        return self._samples

    def __getitem__(self, index: int) -> float:
        block, at = divmod(index, _BLOCK_SAMPLES)
        values = self._blocks.get(block)
        return (self._enter(block) if values is None else values)[at]

    def _enter(self, block: int) -> tuple[float, ...]:
        """The first look into a block; positions and torques of an excitation are read side by side."""
        values = self._ahead.pop(block, None)
        if values is None:
            values = self._load(block)
        if (block + 1) * _BLOCK_SAMPLES < self._samples and block + 1 not in self._blocks:
            self._ahead[block + 1] = self._load(block + 1)
        if len(self._blocks) > 3:
            del self._blocks[next(iter(self._blocks))]
        self._blocks[block] = values
        return values

    def _load(self, block: int) -> tuple[float, ...]:
        data = self._slots.read(self._table * _BLOCKS + block)
        if data is None:
            self._on_bent()
            return (math.nan,) * _BLOCK_SAMPLES
        return struct.unpack_from(f"<{_BLOCK_SAMPLES}d", data, _LENGTH.size)


class Channel:
    """The mapping; both sides use this class, each only its own methods."""

    def __init__(self, fd: int | None = None, clock: Clock | None = None) -> None:
        """Create the memory (supervisor), or map the one behind the inherited descriptor `fd` (loop)."""
        size = _lay_out(memoryview(b""))[-1].end
        self.fd = fd if fd is not None else os.memfd_create("servod-channel")
        if fd is None:
            os.ftruncate(self.fd, size)
        self._clock = clock or WallClock()
        self._memory = mmap.mmap(self.fd, size)
        self._view = memoryview(self._memory)
        self._words = self._view.cast("Q")
        if fd is None:
            self._words[_TAKEN] = self._words[_BEATS] = _counter(0)
        self._slots = _lay_out(self._view)
        self._grants, self._proofs, self._commands, self._records, self._blocks = self._slots
        # the loop's
        self._row = self._proof = 0
        self._beat = self._words[_BEATS]
        self._next_command = 1
        self._taken = [0] * COMMAND_SLOTS  # the tickets as they were taken, by slot
        self._command_index, self._idle = self._commands.index(1), 0
        self._doubts, self._reported_ticket, self._table_bent = 0, -1, False
        self.trajectory = SharedTable(self._blocks, self._doubt_table)
        # the supervisor's
        self._next_record, self._doubtful_record = 1, 0
        self._sent = self._seen_taken = self._beats = self._tables = self._table_samples = 0
        self._seen_grants: list[Grant] | None = None
        self._ready_ns: int | None = None
        self._seen_proofs: tuple[int, WiringReport | None] = 0, None
        self._proof_ticket = self._doubtful_proof = 0
        self._bent = False
        self.lost = 0

    def close(self) -> None:
        """Unmap and close."""
        for slots in self._slots:
            slots.release()
        self._words.release()
        self._view.release()
        self._memory.close()
        os.close(self.fd)

    # --- loop side -----------------------------------------------------------------------------------------------
    def write_record(self, values: Sequence[float]) -> None:
        """Publish one cycle record; `values` in the order of servod.formats.recording.record.FIELDS."""
        self._row += 1
        self._records.write(self._row, _ROW.pack(_ROW.size, *values))

    def write_proof(self, proof: WiringReport) -> None:
        """Publish how a test of the wiring ended; they are seconds apart."""
        self._proof += 1
        self._proofs.write(self._proof, _PROOF.pack(_PROOF.size, *proof))

    def next_command(self) -> Command | None:
        """The next command, or None; called once per cycle. What is bent comes as Op.CORRUPT."""
        if self._words[self._command_index] == self._idle:
            return None
        if self._table_bent:
            self._table_bent = False
            self._idle = self._idle_ticket()
            return self._corrupt()
        number, ticket = self._next_command, self._words[self._command_index]
        if data := self._commands.read(number):
            return self._take(number, data)
        if ticket == self._reported_ticket:  # that slot is given up: the first good one behind it goes on
            for later in range(number + 1, number + COMMAND_SLOTS):
                if data := self._commands.read(later):
                    return self._take(later, data)
            return None
        self._doubts += 1
        if self._doubts <= _TORN_CYCLES:
            return None
        self._doubts, self._reported_ticket, self._idle = 0, ticket, -1
        return self._corrupt()

    def supervisor_beats(self) -> int:
        """A word that a living supervisor changes; what is bent changes nothing."""
        word = self._words[_BEATS]
        if word != self._beat and _is_counter(word):
            self._beat = word
        return self._beat

    def publish_ready(self, grants: Sequence[Grant]) -> None:
        """Tell the supervisor that the cycle begins, and what the operating system granted."""
        text = json.dumps([self._clock.now_ns(), grants]).encode()
        self._grants.write(1, _LENGTH.pack(_LENGTH.size + len(text)) + text)

    def _take(self, number: int, data: bytes) -> Command:
        for taken in range(self._next_command, number + 1):
            self._taken[taken % COMMAND_SLOTS] = self._commands.ticket(taken)
        self._next_command = number + 1
        self._command_index = self._commands.index(number + 1)
        self._doubts, self._reported_ticket = 0, -1
        self._idle = self._idle_ticket()
        self._words[_TAKEN] = _counter(number)
        _, sent_ns, op, table, samples = _MESSAGE.unpack_from(data)
        if op not in _NEVER_TOO_OLD and not 0 <= self._clock.now_ns() - sent_ns <= OLDEST_COMMAND_NS:
            return Command(number, Op.CORRUPT, ())
        arguments = struct.unpack_from(f"<{(len(data) - _MESSAGE.size) // 8}d", data, _MESSAGE.size)
        if op == Op.REFERENCE and arguments and arguments[0] in _TABLES:
            self.trajectory.begin(table, samples)
        return Command(number, op, arguments, sent_ns)

    def _idle_ticket(self) -> int:
        """What the next slot shows until its command comes; -1, which no word is, where another look is wanted."""
        if self._table_bent or self._reported_ticket >= 0:
            return -1
        return self._taken[self._next_command % COMMAND_SLOTS]

    def _corrupt(self) -> Command:
        """In place of a command; its number is the last one's, so that it answers none that is still to come."""
        return Command(self._next_command - 1, Op.CORRUPT, ())

    def _doubt_table(self) -> None:
        self._table_bent, self._idle = True, -1

    # --- supervisor side -----------------------------------------------------------------------------------------
    def beat(self) -> None:
        """Tell the loop that the supervisor lives."""
        self._beats += 1
        self._words[_BEATS] = _counter(self._beats)

    @property
    def ready_ns(self) -> int | None:
        """When the loop began; None before."""
        self.grants()
        return self._ready_ns

    def grants(self) -> list[Grant]:
        """What the operating system granted the loop; empty until it is ready."""
        if self._seen_grants is None and (data := self._grants.read(1)):
            self._ready_ns, grants = json.loads(data[_LENGTH.size :])
            self._seen_grants = [Grant(*row) for row in grants]
        return self._seen_grants or []

    def proofs(self) -> tuple[int, WiringReport | None]:
        """How many tests of the wiring have ended, and how the last one did."""
        ticket = self._proofs.ticket(0)
        if ticket != self._proof_ticket:
            if data := self._proofs.read(ticket >> 32):
                self._seen_proofs = ticket >> 32, WiringReport._make(_PROOF.unpack(data)[1:])
                self._proof_ticket = ticket
            elif ticket == self._doubtful_proof:
                self._bent = True
                self._proof_ticket = ticket
            self._doubtful_proof = ticket
        return self._seen_proofs

    def send(self, op: int, arguments: Sequence[float] = ()) -> int:
        """Queue one command and return its number; 0 when the slots that are open to its kind are taken."""
        number = self._sent + 1
        if number - self._commands_taken() > _OPEN_SLOTS.get(op, _COMMON_SLOTS):
            return 0
        length = _MESSAGE.size + 8 * len(arguments)
        head = _MESSAGE.pack(length, self._clock.now_ns(), op, self._tables, self._table_samples)
        self._commands.write(number, head + struct.pack(f"<{len(arguments)}d", *arguments))
        self._sent = number
        return number

    def write_trajectory(self, samples: Sequence[float]) -> None:
        """Fill the area that table motions read; only while none runs."""
        self._tables, self._table_samples = self._tables + 1, len(samples)
        first, length = self._tables * _BLOCKS, _LENGTH.pack(8 * (_BLOCK_SAMPLES + 1))
        for at in range(0, len(samples), _BLOCK_SAMPLES):
            block = samples[at : at + _BLOCK_SAMPLES]
            data = length + struct.pack(f"<{len(block)}d", *block)
            self._blocks.write(first + at // _BLOCK_SAMPLES, data.ljust(8 * (_BLOCK_SAMPLES + 1), b"\0"))

    def drain(self) -> list[bytes]:
        """All records since the last call, oldest first; `lost` counts those that were bent, or overwritten before
        they were read."""
        rows: list[bytes] = []
        while len(rows) < RECORD_SLOTS:
            if data := self._records.read(self._next_record):
                rows.append(data[_LENGTH.size :])
                self._next_record += 1
            elif not self._pass_over():
                break
        return rows

    def take_corrupt(self) -> bool:
        """Something of the loop's came bent since the last call; the loop itself reports what came so to it."""
        bent, self._bent = self._bent, False
        return bent

    def _pass_over(self) -> bool:
        """Go on behind a record that is overwritten or bent; False at the end of what there is."""
        number = self._next_record
        ticket = self._records.ticket(number)
        ahead = ((ticket >> 32) - number) & _LOW
        if ticket == 0 or (ahead == _LOW + 1 - RECORD_SLOTS and self._records.read(number - RECORD_SLOTS)):
            return False
        if 0 < ahead <= _LOW >> 1 and ahead % RECORD_SLOTS == 0 and self._records.read(number + ahead):
            behind = ahead - RECORD_SLOTS + 2  # the oldest that is whole, and not just being overwritten
            self.lost += behind
            self._next_record += behind
            return True
        if self._doubtful_record != number:  # it may be under way; if not, the next round sees it so again
            self._doubtful_record = number
            return False
        self.lost, self._bent = self.lost + 1, True
        self._next_record += 1
        return True

    def _commands_taken(self) -> int:
        """The last command that the loop has taken, as far as it can be read."""
        word = self._words[_TAKEN]
        behind = (self._sent - (word & _LOW)) & _LOW
        if not _is_counter(word) or behind > self._sent - self._seen_taken:
            self._bent = True
        else:
            self._seen_taken = self._sent - behind
        return self._seen_taken


def _counter(number: int) -> int:
    """A counter in one word, with its complement in the upper half."""
    return (number & _LOW) | (~number & _LOW) << 32


def _is_counter(word: int) -> bool:
    """Whether `word` is one: no single bit makes it another."""
    return (word ^ word >> 32) & _LOW == _LOW


def _lay_out(view: memoryview) -> tuple[_Slots, _Slots, _Slots, _Slots, _Slots]:
    """Grants, wiring tests, commands, records, and blocks of the trajectory area, one behind the other."""
    at = _SLOTS_AT
    rows: list[_Slots] = []
    for count, capacity in (
        (1, 4096),
        (1, 1024),
        (COMMAND_SLOTS, _MESSAGE.size + 8 * MAX_ARGUMENTS),
        (RECORD_SLOTS, _ROW.size),
        (_BLOCKS, 8 * (_BLOCK_SAMPLES + 1)),
    ):
        rows.append(_Slots(view, at, count, capacity))
        at = rows[-1].end
    grants, proofs, commands, records, blocks = rows
    return grants, proofs, commands, records, blocks
