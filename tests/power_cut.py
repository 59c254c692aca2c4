"""What a power cut may leave of a folder: a log of the operations on its files, and all states that fit a prefix.

After ALICE (Pillai et al., OSDI 2014), as hard as POSIX allows: what was not synced may be there, be missing, be cut,
or be zeros of the right length, each write for itself and in any order; a name (creation, rename, removal) lasts only
from the sync of its folder on. `Disk.watch` wraps what Python writes with; `Disk.states` gives the states after each
prefix. That nothing was missed is checked: with every operation kept, the folder is the one that is really there.
"""

from __future__ import annotations

import builtins
import io
import os
import random
import stat
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock

#: A sector: what a disk writes whole or not at all.
_SECTOR = 512
_DRAWN = 4


@dataclass(frozen=True)
class Write:
    """Bytes into a file."""

    file: int
    at: int
    data: bytes


@dataclass(frozen=True)
class Truncate:
    """A file's length."""

    file: int
    size: int


@dataclass(frozen=True)
class Names:
    """Names that come to stand for a file, a folder (-1) or nothing (None), all at once."""

    entries: tuple[tuple[str, int | None], ...]

    @property
    def folders(self) -> set[str]:
        """The folders in which they are."""
        return {str(Path(name).parent) for name, _ in self.entries}


@dataclass(frozen=True)
class Sync:
    """The content of a file, or the names of a folder, are on the disk."""

    file: int | None = None
    folder: str = ""


@dataclass(frozen=True)
class Mark:
    """What the program knows to be done."""

    what: Any


Operation = Write | Truncate | Names | Sync | Mark
Tree = dict[str, bytes | None]


@dataclass(frozen=True)
class Cut:
    """One state: the files below the root by name (folders: None), what was marked before, and when it was."""

    tree: Tree
    marks: tuple[Any, ...]
    time_s: float

    def lay_out(self, root: Path) -> Path:
        """Make the state in an empty folder."""
        for name, content in sorted(self.tree.items()):
            if content is None:
                (root / name).mkdir(parents=True, exist_ok=True)
            else:
                (root / name).write_bytes(content)
        return root


@dataclass
class Disk:
    """The operations below `root`, which is there and empty."""

    root: Path
    log: list[tuple[float, Operation]] = field(default_factory=list)
    _files: dict[tuple[int, int], int] = field(default_factory=dict)
    _count: int = 0

    def mark(self, what: Any) -> None:
        """Note what the program knows by now."""
        self._add(Mark(what))

    @contextmanager
    def watch(self) -> Iterator[None]:
        """Log all operations of this process below the root."""
        patches = [
            mock.patch.object(io, "open", self._open),
            mock.patch.object(builtins, "open", self._open),
            *(mock.patch.object(os, name, self._syncing(getattr(os, name))) for name in ("fsync", "fdatasync")),
            *(mock.patch.object(os, name, self._moving(getattr(os, name))) for name in ("rename", "replace")),
            *(mock.patch.object(os, name, self._removing(getattr(os, name))) for name in ("unlink", "remove")),
            mock.patch.object(os, "mkdir", self._making(os.mkdir)),
        ]
        for patch in patches:
            patch.start()
        try:
            yield
        finally:
            for patch in patches:
                patch.stop()
        there = {
            str(path.relative_to(self.root)): None if path.is_dir() else path.read_bytes()
            for path in self.root.rglob("*")
        }
        assert _tree([op for _, op in self.log]) == there, "an operation was missed"

    def states(self, seed: int = 0) -> Iterator[Cut]:
        """The states that a power cut after each operation may leave, each once."""
        drawn, seen = random.Random(seed), set[int]()
        for length in range(1, len(self.log) + 1):
            operations = [op for _, op in self.log[:length]]
            marks = tuple(op.what for op in operations if isinstance(op, Mark))
            for chosen in _choices(operations, drawn):
                tree = _tree(chosen)
                key = hash((tuple(sorted(tree.items())), len(marks)))
                if key not in seen:
                    seen.add(key)
                    yield Cut(tree, marks, self.log[length - 1][0])

    # --- what is wrapped -----------------------------------------------------------------------------------------
    def _add(self, operation: Operation) -> None:
        self.log.append((time.monotonic(), operation))

    def _name(self, path: Any) -> str | None:
        """The path below the root; None elsewhere."""
        if isinstance(path, int):
            return None
        full = Path(path).absolute()
        return str(full.relative_to(self.root)) if self.root in full.parents else None

    def _number(self, state: os.stat_result, new: bool = False) -> int:
        key = (state.st_dev, state.st_ino)
        if new or key not in self._files:
            self._count += 1
            self._files[key] = self._count
        return self._files[key]

    def _open(
        self,
        file: Any,
        mode: str = "r",
        buffering: int = -1,
        encoding: str | None = None,
        errors: str | None = None,
        newline: str | None = None,
        closefd: bool = True,
        opener: Any = None,
    ) -> Any:
        name = self._name(file) if set(mode) & set("wxa+") else None
        if name is None or opener is not None:  # the latter is without a name: nothing of it lasts
            return _OPEN(file, mode, buffering, encoding, errors, newline, closefd, opener)
        before = Path(file).exists()
        raw = _Logged(os.fspath(file), mode.replace("b", "").replace("t", ""))
        raw.disk, raw.number = self, self._number(os.fstat(raw.fileno()), new=not before)
        if not before:
            self._add(Names(((name, raw.number),)))
        elif "w" in mode:
            self._add(Truncate(raw.number, 0))
        buffered = io.BufferedWriter(raw)
        return buffered if "b" in mode else io.TextIOWrapper(buffered, encoding, errors, newline)

    def _syncing(self, call: Any) -> Any:
        def fsync(descriptor: Any) -> None:
            call(descriptor)
            number = descriptor if isinstance(descriptor, int) else descriptor.fileno()
            state = os.fstat(number)
            path = Path(f"/proc/self/fd/{number}").readlink()
            if stat.S_ISDIR(state.st_mode) and (path == self.root or self.root in path.parents):
                self._add(Sync(folder=str(path.relative_to(self.root))))
            elif (state.st_dev, state.st_ino) in self._files:
                self._add(Sync(file=self._number(state)))

        return fsync

    def _moving(self, call: Any) -> Any:
        def move(source: Any, to: Any) -> None:
            call(source, to)
            names = self._name(source), self._name(to)
            if names[0] is not None and names[1] is not None:
                self._add(Names(((names[0], None), (names[1], self._number(Path(to).stat())))))

        return move

    def _removing(self, call: Any) -> Any:
        def remove(path: Any, **more: Any) -> None:
            call(path, **more)
            if (name := self._name(path)) is not None:
                self._add(Names(((name, None),)))

        return remove

    def _making(self, call: Any) -> Any:
        def make(path: Any, *args: Any, **more: Any) -> None:
            call(path, *args, **more)
            if (name := self._name(path)) is not None:
                self._add(Names(((name, -1),)))

        return make


_OPEN = io.open


class _Logged(io.FileIO):
    """A file that logs what the kernel gets of it."""

    disk: Disk
    number: int

    def write(self, data: Any) -> int:
        """Write, and note what was taken."""
        at = os.fstat(self.fileno()).st_size if "a" in self.mode else self.tell()
        taken = super().write(data) or 0
        self.disk._add(Write(self.number, at, bytes(memoryview(data)[:taken])))
        return taken


def _choices(operations: list[Operation], drawn: random.Random) -> Iterator[list[Operation]]:
    """The operations that are on the disk for sure, with what may be of the others."""
    pending = _pending(operations)
    drops: list[set[int]] = [set(), set(pending)]
    drops += [{one} for one in pending] + [set(pending) - {one} for one in pending]
    drops += [set(pending[n:]) for n in range(1, len(pending))]
    drops += [{one for one in pending if drawn.random() < 0.5} for _ in range(_DRAWN)]
    for dropped in drops:
        yield [op for n, op in enumerate(operations) if n not in dropped]
    bent = [n for n in pending if isinstance(operations[n], Write)]
    for _ in range(_DRAWN if bent else 0):
        some = {n for n in bent if drawn.random() < 0.5} or {drawn.choice(bent)}
        yield [_bent(op, drawn) if n in some else op for n, op in enumerate(operations)]


def _pending(operations: list[Operation]) -> list[int]:
    """Which operations a power cut may still undo."""
    files, folders, found = set[int](), set[str](), list[int]()
    for n in range(len(operations) - 1, -1, -1):
        op = operations[n]
        if isinstance(op, Sync):
            files |= {op.file} if op.file is not None else set()
            folders |= {op.folder} if op.folder else set()
        elif not isinstance(op, Mark) and not (op.folders <= folders if isinstance(op, Names) else op.file in files):
            found.append(n)
    return found[::-1]


def _bent(operation: Operation, drawn: random.Random) -> Operation:
    """A write that was cut at a sector, or whose sectors are zeros here and there."""
    assert isinstance(operation, Write)
    data = operation.data
    at = drawn.randrange(0, len(data) + 1, min(_SECTOR, max(len(data), 1)))
    if drawn.random() < 0.5:
        return Write(operation.file, operation.at, data[:at])
    end = min(len(data), at + drawn.choice((_SECTOR, len(data))))
    return Write(operation.file, operation.at, data[:at] + bytes(end - at) + data[end:])


def _tree(operations: list[Operation]) -> Tree:
    """The folder after these operations; what is in a folder that is not there is lost."""
    contents: dict[int, bytearray] = {}
    names: dict[str, int] = {}
    for op in operations:
        if isinstance(op, Write):
            content = contents.setdefault(op.file, bytearray())
            content.extend(bytes(max(0, op.at - len(content))))
            content[op.at : op.at + len(op.data)] = op.data
        elif isinstance(op, Truncate):
            del contents.setdefault(op.file, bytearray())[op.size :]
        elif isinstance(op, Names):
            for name, number in op.entries:
                names.pop(name, None)
                if number is not None:
                    names[name] = number
    lasting = {name for name in names if all(names.get(str(above)) == -1 for above in list(Path(name).parents)[:-1])}
    return {name: None if names[name] == -1 else bytes(contents.get(names[name], b"")) for name in lasting}
