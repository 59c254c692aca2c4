"""Recordings of an identification on disk: one MCAP file for each motion, and a list that says what each is.

Beside the walk. `load` gives the traces back for fits without an axis; `Recordings` also gives them back to a walk that
is taken up again, motion by motion, as long as the walk asks for the very motions that were recorded. Nothing is ever
thrown away: an axis model names its recordings by their hashes, and it stays in force until another has been written.
"""

from __future__ import annotations

import hashlib
import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from servod.common.errors import BadInput
from servod.common.files import make_folder, read_json, unreadable, unwritable, write_atomically
from servod.common.yaml import Strict, validate
from servod.formats.model.identified import Devices
from servod.formats.recording.mcap_reader import read_recording
from servod.formats.recording.mcap_writer import split_rows, wall_offset_ns, write_whole
from servod.lab.identify.trace import ExperimentKind, RecordedMotion

LIST = "experiments.json"
#: Folders within the recordings' own, counted up, that earlier walks are set aside in.
ASIDE = "before_{:02d}"
_FILES = "[0-9][0-9]_*.mcap"
_ALLOWED = "a folder that servoctl identify wrote"
_COLUMNS = ("torque_nm", "position_rad", "reference_rad", "torque_other_nm", "torque_actual_nm", "motor_position_rad")


class _Entry(Strict):
    """One recording; `motion` is the hash of what was asked for, `sha256` the file's (None: an earlier version's)."""

    file: str = Field(pattern=r"^[0-9]{2,}_[a-z_]+\.mcap$")
    kind: ExperimentKind
    motion: str
    sha256: str | None = None
    settings: dict[str, float]


class _List(Strict):
    """Content of the list."""

    conditions: str
    start_rad: float | None
    devices: Devices | None = None
    experiments: list[_Entry]


class Recordings:
    """A folder that gets a file for every motion, as soon as it is over.

    `start_rad` is where the axis stood when the walk began; None until `begin`.
    """

    def __init__(self, folder: Path, conditions: str = "", resume: bool = False, offset_ns: int | None = None) -> None:
        """Use `folder`; earlier recordings in it go on with `resume` while they fit, and are else set aside.

        That happens when the first new motion is kept: a walk that is refused leaves all as it was. They fit when they
        were made under the same `conditions` (a hash of configuration and options). `offset_ns` turns the records' time
        into the time of day (None: they have the monotonic clock's). Raises BadInput.
        """
        self.folder, self.conditions = folder, conditions
        self._offset_ns = wall_offset_ns() if offset_ns is None else offset_ns
        self.start_rad: float | None = None
        self.devices: Devices | None = None
        self._done: list[_Entry] = []
        self._earlier: list[_Entry] = []
        if resume:
            self._take_up()
        self._make_folder()

    @property
    def waiting(self) -> int:
        """Earlier recordings that the walk has not asked for yet."""
        return len(self._earlier)

    def begin(self, start_rad: float, devices: Devices | None = None) -> None:
        """The walk begins with the axis at `start_rad`, on these devices."""
        self.start_rad, self.devices = start_rad, devices

    def recorded(self, kind: ExperimentKind, motion: str) -> RecordedMotion | None:
        """The earlier recording of the next motion; None when there is none, and then no later one is given either.

        Raises BadInput when its file is not the one that was recorded.
        """
        if not self._earlier:
            return None
        entry = self._earlier.pop(0)
        if (entry.kind, entry.motion) != (kind, motion):
            self._earlier = []
            return None
        self._done.append(entry)
        return _trace(self.folder, entry)

    def keep(self, rows: NDArray[np.void], trace: RecordedMotion, motion: str = "") -> RecordedMotion:
        """Write one motion and the list with it; returns the trace with the file's hash. Raises BadInput."""
        name = f"{len(self._done):02d}_{trace.kind.value}.mcap"
        try:
            self._set_aside()
            write_whole(self.folder / name, split_rows(rows.tobytes()), self._offset_ns)
            sha256 = file_sha256(self.folder / name)
            entry = _Entry(file=name, kind=trace.kind, motion=motion, sha256=sha256, settings=trace.settings)
            self._done.append(entry)
            try:
                self._write_list()
            except OSError:
                (self.folder / name).unlink()
                raise
        except OSError as error:
            raise _unwritable(self.folder / name, error) from None
        return replace(trace, sha256=sha256)

    def _write_list(self) -> None:
        written = _List(
            conditions=self.conditions, start_rad=self.start_rad, devices=self.devices, experiments=self._done
        )
        write_atomically(self.folder / LIST, written.model_dump_json(indent=1) + "\n")

    def _take_up(self) -> None:
        """Find the earlier recordings, if they were made under these conditions."""
        if not (self.folder / LIST).exists():
            return
        earlier = _read_list(self.folder)
        if earlier.conditions == self.conditions and earlier.start_rad is not None:
            self.start_rad, self._earlier = earlier.start_rad, list(earlier.experiments)

    def _make_folder(self) -> None:
        try:
            make_folder(self.folder)
        except OSError as error:
            raise _unwritable(self.folder, error) from None

    def _set_aside(self) -> None:
        """Move an earlier walk of which this one does not use everything to a folder of its own, whole."""
        there = sorted(self.folder.glob(_FILES))
        unused = {path.name for path in there} - {entry.file for entry in self._done}
        if not unused:
            return
        aside = next(path for n in range(1, 1_000_000) if not (path := self.folder / ASIDE.format(n)).exists())
        aside.mkdir()
        for path in there:
            _copy(path, aside / path.name)
        if (self.folder / LIST).exists():
            shutil.copyfile(self.folder / LIST, aside / LIST)
        for name in unused:
            (self.folder / name).unlink()


def motion_hash(positions: NDArray[np.float64], torques: NDArray[np.float64], window_rad: float) -> str:
    """Hash of what a motion asks for: equal for the same experiment after the same earlier ones."""
    asked = hashlib.sha256()
    for values in (positions, torques, np.array([window_rad])):
        asked.update(np.ascontiguousarray(values, dtype=np.float64).tobytes())
    return asked.hexdigest()


def load(folder: Path) -> list[RecordedMotion]:
    """All traces that `Recordings` wrote to `folder`. Raises BadInput."""
    return [_trace(folder, entry) for entry in _read_list(folder).experiments]


def load_devices(folder: Path) -> Devices | None:
    """The devices that they were recorded with; None where nobody asked. Raises BadInput."""
    return _read_list(folder).devices


def _read_list(folder: Path) -> _List:
    path = folder / LIST
    document = read_json(path, _ALLOWED)
    if isinstance(document, list):
        raise BadInput(str(path), "a list as earlier versions wrote it", f"{_ALLOWED} of this version; identify again")
    return validate(document, _List, str(path))


def _trace(folder: Path, entry: _Entry) -> RecordedMotion:
    path = folder / entry.file
    sha256 = _require_same(path, entry)
    recording = read_recording(path)
    missing = [name for name in ("time_ns", *_COLUMNS) if name not in recording.names]
    if missing or not recording:
        found = f"no {missing[0]}" if missing else "no cycles"
        raise BadInput(str(path), found, "a recording that servoctl identify wrote")
    time_ns = np.asarray(recording.column("time_ns"), dtype=np.int64)
    torque, position, reference, excitation, actual, motor = (
        np.asarray(recording.column(column), dtype=np.float64) for column in _COLUMNS
    )
    t_s = (time_ns - time_ns[0]) * 1e-9
    return RecordedMotion(
        entry.kind, t_s, torque, position, reference, excitation, actual, motor, entry.settings, sha256
    )


def _require_same(path: Path, entry: _Entry) -> str:
    """The file's hash, which must be the listed one. Raises BadInput."""
    try:
        found = file_sha256(path)
    except OSError as error:
        raise unreadable(path, error, f"the recording that {LIST} lists") from None
    if entry.sha256 not in (None, found):
        why = "a file that was changed or cut short after it was recorded"
        raise BadInput(str(path), why, f"the recording that {LIST} lists; without {LIST} the axis is identified again")
    return found


def _copy(path: Path, to: Path) -> None:
    """Another name for the same file; its content where the file system knows no such thing."""
    try:
        os.link(path, to)
    except OSError:
        shutil.copyfile(path, to)


def file_sha256(path: Path) -> str:
    """Hash of a recording, as the list has it."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _unwritable(path: Path, error: OSError) -> BadInput:
    return unwritable(path, error)
