"""The gain-set store: a directory with every version of every set, which one is active, and what happened when.

Beside the data path; the supervisor owns it, `servoctl gains` reaches it through the supervisor.

    DIRECTORY/sets/NAME/0001.yaml   text of version 1 with a seal, never changed after it was written
    DIRECTORY/active.json           the active version and those before it with their hash, replaced as a whole
    DIRECTORY/active.copy.json      the same once more, written after it, for the case that it is damaged
    DIRECTORY/history.jsonl         one line for each load, activation, rollback and rejected trial, for people
    DIRECTORY/lock                  held while something changes

Every file is written aside, flushed to the disk and renamed, so that a kill at any moment leaves the old state or the
new one. `active.json` alone decides; the history line comes after it and may be the one thing that a kill loses.

What is read is what was written, or it is refused: hashes show every change by accident, as of a bit on the disk. They
are no signature: who means to can compute them again.
"""

from __future__ import annotations

import contextlib
import datetime
import hashlib
import logging
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from pydantic import Field

from servod.common.errors import BadInput
from servod.common.files import (
    MOST_BYTES,
    make_folder,
    open_file,
    open_to_append,
    read_bytes,
    read_json,
    read_text,
    reason,
    unreadable,
    unwritable,
    write_atomically,
)
from servod.common.portable import lock_file
from servod.common.yaml import Strict, validate
from servod.formats.gains.gain_set import NAME_PATTERN, GainSet, Sha256, parse_gains, require_certificate

_VERSION_FILE = re.compile(r"^([0-9]{4,})\.yaml$")
_NAME = re.compile(NAME_PATTERN)
MAX_ROLLBACKS = 100
#: Lines of the history that are kept at the least; a store that has twice as many when it is opened forgets the oldest.
_KEPT_LINES = 5000

log = logging.getLogger("servod.gains")


class Action(StrEnum):
    """What a history line tells of."""

    LOAD = "load"
    ACTIVATE = "activate"
    ROLLBACK = "rollback"
    REJECT = "reject"  # a set that was tried and not kept


@dataclass(frozen=True, slots=True)
class StoredSet:
    """One version of one gain set in the store; `sha256` is of the file's `text` in UTF-8."""

    name: str
    version: int
    sha256: str
    path: Path
    gains: GainSet
    text: str


class SetReference(Strict):
    """Name and version of a stored set."""

    name: str
    version: int


class HistoryEntry(Strict):
    """One line of the history; `time` is UTC. A deployment leaves its reasons in `note` and what it measured."""

    time: datetime.datetime
    action: Action
    name: str
    version: int
    sha256: str
    note: str = ""
    figures: dict[str, float] = Field(default_factory=dict)


class _Active(Strict):
    """Content of active.json; `previous` has the last one at its end. The hash is of the rest; earlier versions wrote
    none."""

    current: SetReference
    previous: list[SetReference]
    sha256: Sha256 | None = None

    def content_sha256(self) -> str:
        """Hash of all but itself."""
        return hashlib.sha256(self.model_dump_json(exclude={"sha256"}).encode()).hexdigest()


def sealed_text(text: str, gains: GainSet) -> str:
    """The text of a set with its seal: as it is where it has one, else with one at its end, comments and all."""
    if gains.seal is not None:
        return text
    sealed = gains.sealed()
    found = f"{text.rstrip()}\nseal: {sealed.seal}\n"
    with contextlib.suppress(BadInput):  # a document in braces, or with an end of its own
        if parse_gains(found, gains.name) == sealed:
            return found
    return sealed.to_yaml()


#: A file that was changed is refused by `gains load`, too.
_INSTEAD = "`servoctl gains activate` another version, or make the set again (`servoctl synthesize`, then `verify`)"


class GainStore:
    """A directory of gain sets. Raises BadInput when the directory cannot be used or a set is unknown or bad.

    Of each name the newest `max_versions` are kept, and those that are active or that a rollback leads to. `damage` is
    what was wrong with the active set's file when it was last read: empty, or a sentence.
    """

    def __init__(self, directory: Path, max_versions: int = 100, mends: bool = True) -> None:
        """With `mends` False, what says which set is active stays as it is until `mend`."""
        self.directory, self.damage, self._max_versions = directory, "", max_versions
        self._sets, self._active_file = directory / "sets", directory / "active.json"
        self._active_copy = directory / "active.copy.json"
        self._history_file = directory / "history.jsonl"
        self._parsed: dict[Path, tuple[tuple[int, ...], StoredSet]] = {}
        try:
            make_folder(self._sets)
            with self._locked():
                self._sweep()
            if mends:
                self.mend()
        except OSError as error:
            raise unwritable(f"gain store {error.filename or directory}", error) from None

    @contextlib.contextmanager
    def _locked(self) -> Iterator[None]:
        """One writer at a time, also across processes; the lock ends with the process, however it ends."""
        with open_to_append(self.directory / "lock") as file:
            lock_file(file, wait=True)
            yield

    def _sweep(self) -> None:
        """Remove what a kill left half-written, end a history line that it cut; tell of a history that is no file."""
        for leftover in self.directory.rglob("*.tmp"):
            if leftover.is_file():
                leftover.unlink()
        with contextlib.suppress(OSError):  # a disk that takes nothing: later; no line of it is needed to run
            if self._history_file.exists() and not self._history_file.is_file():
                log.warning("%s: is no file; move it away: until then what happens leaves no line", self._history_file)
                return
            if self._history_file.exists() and not self._history_bytes().endswith(b"\n"):
                with open_to_append(self._history_file) as file:
                    file.write(b"\n")
            lines = self._history_lines()
            if len(lines) > 2 * _KEPT_LINES or self._history_file.stat().st_size > MOST_BYTES:
                write_atomically(self._history_file, "\n".join(lines[-_KEPT_LINES:]) + "\n")

    def mend(self) -> None:
        """Rewrite the record of the active set where it is damaged, has no copy or an old one, or is of an earlier
        version."""
        with self._locked(), contextlib.suppress(BadInput, OSError):  # nothing to mend it with, or a full disk: later
            state = self._active()
            if state is None or (state.sha256 and not self.damage and self._copy_is_the_same()):
                return
            if not self.damage and self._active_copy.exists():
                log.warning("%s: is not what %s says; written again from it", self._active_copy, self._active_file.name)
            self._write_active(state)

    def _copy_is_the_same(self) -> bool:
        """A power cut between the two files, or a disk that took only one, leaves a copy that names an older set."""
        try:
            return read_bytes(self._active_copy) == read_bytes(self._active_file)
        except BadInput:
            return False

    def load(self, text: str, where: str, name: str | None = None) -> StoredSet:
        """Check a gain set and store it as the next version of its name; the newest text again gets none.

        One whose certificate or seal does not belong to its numbers is not stored: it could never be activated. One
        without a seal, of an earlier version or by hand, gets it here. `name`, when given, must be the name in the
        file: one set is never known by two names. `where` is for errors.
        """
        gains = parse_gains(text, where)
        if name is not None and name != gains.name:
            raise BadInput(f"{where}: name", gains.name, f"{name}, the name it shall be loaded as")
        require_certificate(gains, accept_uncertified=True, where=where)
        text = sealed_text(text, gains)
        with self._locked():
            newest = max(self._versions(gains.name), default=0)
            if newest and _holds(self._path(gains.name, newest), text):
                return self.get(gains.name, newest)
            version = newest + 1
            path = self._path(gains.name, version)
            make_folder(path.parent)
            write_atomically(path, text)
            stored = self.get(gains.name, version)
            self._log(Action.LOAD, stored)
            self._drop_old(gains.name)
            return stored

    def _drop_old(self, name: str) -> None:
        """Remove the oldest versions beyond the cap; without knowing what is active, none."""
        with contextlib.suppress(BadInput, OSError):
            state = self._active()
            used = {(one.name, one.version) for one in (*state.previous, state.current)} if state else set()
            for version in self._versions(name)[: -self._max_versions]:
                if (name, version) not in used:
                    self._path(name, version).unlink()
                    log.info("gain set %s version %d removed: the oldest beyond gains.max_versions", name, version)

    def load_file(self, path: str | Path) -> StoredSet:
        """Store the gain-set file at `path`; see `load`."""
        return self.load(read_text(path), str(path))

    def get(self, name: str, version: int | None = None) -> StoredSet:
        """The stored set, by default its newest version; checked again, since somebody may have edited the file.

        It is read once: what is checked is what runs, whatever becomes of the file meanwhile.
        """
        versions = self._versions(name)
        if not versions:
            raise BadInput("gain set", name, ", ".join(self.names()) or "none is stored yet; `servoctl gains load` one")
        chosen = versions[-1] if version is None else version
        if chosen not in versions:
            raise BadInput(f"gain set {name}: version", version, ", ".join(map(str, versions)))
        return self._read(name, chosen)

    def _read(self, name: str, version: int) -> StoredSet:
        """One version, as it was stored; parsed again only when its file was touched since, so that lists are cheap."""
        path = self._path(name, version)
        try:
            status = path.stat()
        except OSError as error:
            raise unreadable(path, error) from None
        touched = (status.st_ino, status.st_mtime_ns, status.st_ctime_ns, status.st_size)
        before, stored = self._parsed.get(path, (None, None))
        if stored is None or before != touched:
            text = read_text(path)
            gains = parse_gains(text, str(path))
            if gains.name != name:
                raise BadInput(f"{path}: name", gains.name, f"{name}, under which it was stored; {_INSTEAD}")
            stored = StoredSet(name, version, hashlib.sha256(text.encode()).hexdigest(), path, gains, text)
            self._require_as_stored(stored)
            self._parsed[path] = touched, stored
        return stored

    def _require_as_stored(self, found: StoredSet) -> None:
        """Refuse numbers that are not those which were stored. Raises BadInput.

        The seal tells. Earlier versions stored some sets without one: of these the hash in the history does.
        """
        if found.gains.seal is not None:
            if not found.gains.seal_broken:
                return
            problem = "numbers that were changed after the set was sealed"
        else:
            if any((one.action, one.sha256) == (Action.LOAD, found.sha256) for one in self.history()):
                return
            problem = "no seal, and no hash of it in the history: it is not what was stored"
        raise BadInput(f"{found.path}: seal", problem, f"the file as it was stored; {_INSTEAD}")

    def names(self) -> list[str]:
        """Names of all stored sets, in order."""
        return sorted(entry.name for entry in self._sets.iterdir() if self._versions(entry.name))

    def versions(self) -> list[tuple[str, int]]:
        """Every version of every set, by name and version."""
        return [(name, version) for name in self.names() for version in self._versions(name)]

    def stored(self) -> list[StoredSet]:
        """All of them, each as it was stored. Raises BadInput at the first that is not."""
        return [self.get(name, version) for name, version in self.versions()]

    def active(self) -> StoredSet | None:
        """The active set; None before the first activation."""
        current = self.active_reference()
        return None if current is None else self.get(current.name, current.version)

    def active_reference(self) -> SetReference | None:
        """Name and version of the active set, whatever has become of its file; None before the first activation."""
        state = self._active()
        return None if state is None else state.current

    def activate(
        self, name: str, version: int | None = None, note: str = "", figures: dict[str, float] | None = None
    ) -> StoredSet:
        """Make a stored set the active one; the present one becomes what `rollback` returns to."""
        with self._locked():
            stored = self.get(name, version)
            try:
                state = self._active()
            except BadInput as error:  # the set is named, so there is no need to know the one before
                log.error("%s; the activations before this one are forgotten", error)
                state = None
            new = SetReference(name=stored.name, version=stored.version)
            if state is None:
                self._write_active(_Active(current=new, previous=[]))
            elif state.current != new:
                previous = [*state.previous, state.current][-MAX_ROLLBACKS:]
                self._write_active(_Active(current=new, previous=previous))
            self._log(Action.ACTIVATE, stored, note, figures)
            return stored

    def reject(self, name: str, version: int, note: str = "", figures: dict[str, float] | None = None) -> StoredSet:
        """Note that a stored set was tried and not kept; what is active stays so."""
        with self._locked():
            stored = self.get(name, version)
            self._log(Action.REJECT, stored, note, figures)
            return stored

    def previous(self) -> StoredSet:
        """What `rollback` would return to. Raises BadInput when there is nothing before the active set."""
        state = self._active()
        if state is None or not state.previous:
            raise BadInput("gain store: rollback", "no set that was active before", "at least two activations")
        return self.get(state.previous[-1].name, state.previous[-1].version)

    def rollback(self) -> StoredSet:
        """Make the set active that was so before the present one; again and again, back to the first."""
        with self._locked():
            stored, state = self.previous(), self._active()
            assert state is not None  # `previous` found one
            self._write_active(_Active(current=state.previous[-1], previous=state.previous[:-1]))
            self._log(Action.ROLLBACK, stored)
            return stored

    def history(self) -> list[HistoryEntry]:
        """What happened, oldest first; a line that a kill cut short is left out."""
        entries = []
        for line in self._history_lines():
            with contextlib.suppress(ValueError):
                entries.append(HistoryEntry.model_validate_json(line))
        return entries

    def _history_lines(self) -> list[str]:
        return self._history_bytes().decode("utf-8", errors="replace").splitlines()

    def _history_bytes(self) -> bytes:
        """The end of it where it has grown beyond what is read; nothing where it cannot be read, or is no file."""
        try:
            with open_file(self._history_file) as stream:
                size = stream.seek(0, os.SEEK_END)
                stream.seek(max(size - MOST_BYTES, 0))
                return stream.read(MOST_BYTES)
        except OSError:
            return b""

    def _versions(self, name: str) -> list[int]:
        folder = self._sets / name
        if not _NAME.match(name) or not folder.is_dir():
            return []
        return sorted(int(m[1]) for m in (_VERSION_FILE.match(entry.name) for entry in folder.iterdir()) if m)

    def _path(self, name: str, version: int) -> Path:
        return self._sets / name / f"{version:04d}.yaml"

    def _active(self) -> _Active | None:
        """What active.json says, or its copy where it is damaged or gone. Raises BadInput when neither can be read."""
        files = [file for file in (self._active_file, self._active_copy) if file.exists()]
        if not files:
            return None
        try:
            if files[0] == self._active_copy:
                raise BadInput(str(self._active_file), "no file, although it has a copy", "the file as servod wrote it")
            return _read_active(self._active_file)
        except BadInput as error:
            if self._active_copy not in files:
                raise
            try:
                state = _read_active(self._active_copy)
            except BadInput as second:
                found = f"{error.found}; in its copy {self._active_copy.name} {second.found}"
                raise BadInput(error.where, found, "the file as servod wrote it, or its copy") from None
            self.damage = f"{error}; {self._active_copy.name} was taken in its place"
            log.error("%s", self.damage)
            return state

    def _write_active(self, state: _Active) -> None:
        text = state.model_copy(update={"sha256": state.content_sha256()}).model_dump_json(indent=1) + "\n"
        write_atomically(self._active_file, text)
        try:
            write_atomically(self._active_copy, text)
        except OSError as error:  # what is active is written and stands; no copy is better than an older one
            log.warning("%s: without a copy (%s)", self._active_copy, reason(error))
            with contextlib.suppress(OSError):
                self._active_copy.unlink(missing_ok=True)

    def _log(self, action: Action, stored: StoredSet, note: str = "", figures: dict[str, float] | None = None) -> None:
        entry = HistoryEntry(
            time=datetime.datetime.now(datetime.UTC),
            action=action,
            name=stored.name,
            version=stored.version,
            sha256=stored.sha256,
            note=note,
            figures=figures or {},
        )
        try:
            with open_to_append(self._history_file) as file:
                file.write(entry.model_dump_json().encode() + b"\n")
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:  # what the line tells of is done and stands: a full disk shall not call it undone
            log.warning("%s: without a line on %s %s (%s)", self._history_file, action, stored.name, reason(error))


def _holds(path: Path, text: str) -> bool:
    """Whether a file has just this text."""
    try:
        return read_bytes(path) == text.encode()
    except BadInput:
        return False


def _read_active(path: Path) -> _Active:
    written = "the file as servod wrote it"
    state = validate(read_json(path, written), _Active, str(path))
    if state.sha256 not in (None, state.content_sha256()):
        raise BadInput(f"{path}: sha256", "a hash of other content", written)
    return state
