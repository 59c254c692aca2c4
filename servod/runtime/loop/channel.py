"""Shared memory between supervisor and loop: cycle records out, commands in, one writer and one reader for each.

The writer fills a slot and only then moves the head, which is one aligned 8-byte store; the reader copies slots and
then looks at the head again, dropping (and counting) what was overwritten meanwhile. Nobody ever waits for the other.
"""

from __future__ import annotations

import json
import mmap
import os
import struct
from collections.abc import Sequence
from enum import IntEnum

from servod.formats.recording.record import RECORD
from servod.runtime.loop.commands import Command, Op
from servod.runtime.loop.realtime import Grant
from servod.runtime.loop.wiring.findings import WiringReport

RECORD_SLOTS = 8192  # eight seconds at 1 kHz for a supervisor that hangs
COMMAND_SLOTS = 16
COMMAND_SLOT_BYTES = 16_384
#: How far each kind of command may fill the queue: whoever floods it leaves room for a stop, and that for what the
#: supervisor itself has to say.
_COMMON_SLOTS = COMMAND_SLOTS // 2
_OPEN_SLOTS: dict[int, int] = {
    Op.DISABLE: COMMAND_SLOTS - 6,
    Op.QUICK_STOP: COMMAND_SLOTS - 4,
    Op.NODE_EVENT: COMMAND_SLOTS,
    Op.SHUTDOWN: COMMAND_SLOTS,
}
MAX_ARGUMENTS = (COMMAND_SLOT_BYTES - 24) // 8
TRAJECTORY_SAMPLES = 300_000  # five minutes at 1 kHz

_HEADER_BYTES = 4096
_GRANTS_BYTES = 4096
_COMMANDS_AT = _HEADER_BYTES + _GRANTS_BYTES
_RECORDS_AT = _COMMANDS_AT + COMMAND_SLOTS * COMMAND_SLOT_BYTES
_TRAJECTORY_AT = _RECORDS_AT + RECORD_SLOTS * RECORD.size
_SIZE = _TRAJECTORY_AT + TRAJECTORY_SAMPLES * 8
_COMMAND_HEAD = struct.Struct("<qqq")
_PROOF_AT = _HEADER_BYTES // 2  # behind the words, in the same page
_PROOF = struct.Struct(f"<{len(WiringReport._fields)}d")


class _Word(IntEnum):
    """Position of each 8-byte word in the header."""

    RECORD_HEAD = 0
    COMMAND_HEAD = 1
    COMMAND_TAIL = 2
    SUPERVISOR_BEATS = 3
    LOOP_READY = 4
    PROOFS = 5  # tests of the wiring that ended


class Channel:
    """The mapping; both sides use this class, each only its own methods."""

    def __init__(self, fd: int | None = None) -> None:
        """Create the memory (supervisor), or map the one behind the inherited descriptor `fd` (loop)."""
        self.fd = fd if fd is not None else os.memfd_create("servod-channel")
        if fd is None:
            os.ftruncate(self.fd, _SIZE)
        self._memory = mmap.mmap(self.fd, _SIZE)
        self._view = memoryview(self._memory)
        self._words = self._view[:_HEADER_BYTES].cast("q")
        self.trajectory = self._view[_TRAJECTORY_AT:_SIZE].cast("d")
        self._head = 0
        self._read_records = 0
        self.lost = 0

    def close(self) -> None:
        """Unmap and close."""
        self._words.release()
        self.trajectory.release()
        self._view.release()
        self._memory.close()
        os.close(self.fd)

    # --- loop side -----------------------------------------------------------------------------------------------
    def write_record(self, values: Sequence[float]) -> None:
        """Publish one cycle record; `values` in the order of servod.formats.recording.record.FIELDS."""
        head = self._head
        RECORD.pack_into(self._memory, _RECORDS_AT + (head % RECORD_SLOTS) * RECORD.size, *values)
        self._head = head + 1
        self._words[0] = head + 1

    def write_proof(self, proof: WiringReport) -> None:
        """Publish how a test of the wiring ended; they are seconds apart."""
        _PROOF.pack_into(self._memory, _PROOF_AT, *proof)
        self._words[_Word.PROOFS] += 1

    def next_command(self) -> Command | None:
        """The next command, or None; called once per cycle."""
        words = self._words
        tail = words[2]
        if tail == words[1]:
            return None
        at = _COMMANDS_AT + (tail % COMMAND_SLOTS) * COMMAND_SLOT_BYTES
        seq, op, count = _COMMAND_HEAD.unpack_from(self._memory, at)
        arguments = struct.unpack_from(f"<{count}d", self._memory, at + _COMMAND_HEAD.size)
        words[2] = tail + 1
        return Command(seq, op, arguments)

    def supervisor_beats(self) -> int:
        """Counter that a living supervisor moves on."""
        return self._words[3]

    def publish_ready(self, grants: Sequence[Grant]) -> None:
        """Tell the supervisor that the cycle begins, and what the operating system granted."""
        text = json.dumps(grants).encode()[: _GRANTS_BYTES - 8]
        struct.pack_into(f"<q{len(text)}s", self._memory, _HEADER_BYTES, len(text), text)
        self._words[_Word.LOOP_READY] = 1

    # --- supervisor side -----------------------------------------------------------------------------------------
    def beat(self) -> None:
        """Tell the loop that the supervisor lives."""
        self._words[_Word.SUPERVISOR_BEATS] += 1

    @property
    def ready(self) -> bool:
        """The loop has begun."""
        return self._words[_Word.LOOP_READY] == 1

    def grants(self) -> list[Grant]:
        """What the operating system granted the loop; empty until it is ready."""
        if not self.ready:
            return []
        (length,) = struct.unpack_from("<q", self._memory, _HEADER_BYTES)
        text = bytes(self._view[_HEADER_BYTES + 8 : _HEADER_BYTES + 8 + length])
        return [Grant(*row) for row in json.loads(text)]

    def proofs(self) -> tuple[int, WiringReport | None]:
        """How many tests of the wiring have ended, and how the last one did."""
        count = self._words[_Word.PROOFS]
        return count, WiringReport._make(_PROOF.unpack_from(self._memory, _PROOF_AT)) if count else None

    def send(self, command: Command) -> bool:
        """Queue one command; False when the slots that are open to its kind are taken."""
        head = self._words[_Word.COMMAND_HEAD]
        if head - self._words[_Word.COMMAND_TAIL] >= _OPEN_SLOTS.get(command.op, _COMMON_SLOTS):
            return False
        at = _COMMANDS_AT + (head % COMMAND_SLOTS) * COMMAND_SLOT_BYTES
        count = len(command.arguments)
        _COMMAND_HEAD.pack_into(self._memory, at, command.seq, command.op, count)
        struct.pack_into(f"<{count}d", self._memory, at + _COMMAND_HEAD.size, *command.arguments)
        self._words[_Word.COMMAND_HEAD] = head + 1
        return True

    def drain(self) -> list[bytes]:
        """All records since the last call, oldest first; what was overwritten before it was read counts in `lost`."""
        head = self._words[_Word.RECORD_HEAD]
        first = max(self._read_records, head - RECORD_SLOTS)
        records = [self._record(number) for number in range(first, head)]
        overwritten = max(0, min(self._words[_Word.RECORD_HEAD] - RECORD_SLOTS + 1 - first, len(records)))
        self.lost += first - self._read_records + overwritten
        self._read_records = head
        return records[overwritten:]

    def _record(self, number: int) -> bytes:
        at = _RECORDS_AT + (number % RECORD_SLOTS) * RECORD.size
        return bytes(self._view[at : at + RECORD.size])
