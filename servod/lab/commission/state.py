"""What is done of a walk: each step by the hash of what it was made from, so that a step is redone when that changes.

Under the walk. A step counts as done only when its files were complete; the record is written after them, as a whole,
with their hashes: a file that was edited since is neither taken for the step's own nor overwritten in silence.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from pydantic import Field

from servod.common import files
from servod.common.errors import BadInput, Unreachable
from servod.common.files import is_there, read_json, unwritable, write_bytes, write_file
from servod.common.portable import lock_folder
from servod.common.yaml import Strict, validate

# --- Files of a walk -------------------------------------------------------------------------------------------------
# Names of the files in a walk's folder, and how plain values get into them.


RECORDINGS = "recordings"
MODEL, IDENTIFIED = "model.yaml", "identified.json"
DESIGN, RELAXED, INFEASIBLE = "design.yaml", "relaxed.json", "infeasible.json"
GAINS, CERTIFICATE = "gains.yaml", "certificate.json"
STORE, DEPLOYMENT = "store", "deployment.json"
BEFORE, BEFORE_ROWS, AFTER_ROWS = "runs/before.json", "runs/deploy_before.mcap", "runs/deploy_after.mcap"
RIVALS, TUNING = "rivals", "tuning.json"
TRACKING, RUNS = "tracking.json", "runs"
REPORT, REFUSED, PICTURES = "report.html", "refused.html", "pictures"
RESULT = "commission.json"
#: What steps had left that are done again.
EARLIER = "earlier"


def write_text(path: Path, text: str) -> None:
    """Replace a file as a whole. Raises BadInput."""
    write_bytes(path, text.encode())


def write_json(path: Path, document: Any) -> None:
    """Replace a JSON file as a whole. Raises BadInput."""
    write_text(path, json.dumps(document, indent=1, allow_nan=False) + "\n")


def read_walk_json(path: Path) -> Any:
    """The document of a JSON file of the walk. Raises BadInput."""
    return files.read_json(path, "the JSON that servoctl commission wrote")


STATE = "state.json"


class StepRecord(Strict):
    """One step that is done: hash of its inputs, how long it took, and the hash of each file that it left."""

    inputs_sha256: str
    seconds: float
    files_sha256: dict[str, str] = Field(default_factory=dict)


class _Content(Strict):
    """The file."""

    axis: dict[str, Any] = Field(description="which axis this is the commissioning of")
    steps: dict[str, StepRecord] = Field(default_factory=dict)


class State:
    """The walk's state in its folder."""

    def __init__(self, folder: Path, axis: dict[str, Any], own_files: Sequence[str]) -> None:
        """Begin in an empty folder, or take up the walk on the same axis. `own_files`: names that the walk writes.

        Raises BadInput when the folder belongs to another axis or has files of somebody else under these names.
        """
        self.folder, self._path = folder, folder / STATE
        if self._path.exists():
            self._content = self._load()
            self._refuse_other_axis(axis)
        else:
            self._refuse_foreign_files(own_files)
            self._content = _Content(axis=axis)
            self._write()

    @property
    def seconds(self) -> dict[str, float]:
        """How long each step took that is done."""
        return {name: record.seconds for name, record in self._content.steps.items()}

    def done(self, step: str, inputs: dict[str, Any], outputs: Sequence[str]) -> bool:
        """Whether the step was done with these inputs and its files are there.

        Raises BadInput when one of them is not what the step wrote, whatever else speaks for doing the step again: that
        would overwrite it.
        """
        record = self._content.steps.get(step)
        if record is None:
            return False
        self._refuse_edited_files(step, record)
        there = all((self.folder / name).exists() for name in {*outputs, *record.files_sha256})
        return there and record.inputs_sha256 == digest(inputs)

    def begin(self, step: str, outputs: Sequence[str]) -> None:
        """The step is not done, and nothing in its place says that it is, should it end with a no or not at all.

        What it had left goes to the folder EARLIER, what an interruption left of it goes. Its runs stay: they are data
        that say themselves what they are of.
        """
        record = self._content.steps.get(step)
        for name in outputs:
            if (self.folder / name).is_file() and not name.startswith(f"{RUNS}/"):
                self._clear(name, keep=record is not None)
        if record:
            others = {name: record for name, record in self._content.steps.items() if name != step}
            self._content = self._content.model_copy(update={"steps": others})
            self._write()

    def record(self, step: str, inputs: dict[str, Any], seconds: float, outputs: Sequence[str]) -> None:
        """The step is done; its files are complete."""
        files = {name: file_sha256(self.folder / name) for name in outputs if (self.folder / name).is_file()}
        done = StepRecord(inputs_sha256=digest(inputs), seconds=round(seconds, 3), files_sha256=files)
        self._content = self._content.model_copy(update={"steps": self._content.steps | {step: done}})
        self._write()

    def _clear(self, name: str, keep: bool) -> None:
        """Take a file out of the way of its successor."""
        if not keep:
            (self.folder / name).unlink()
            return
        aside = self.folder / EARLIER / name
        aside.parent.mkdir(parents=True, exist_ok=True)
        (self.folder / name).replace(aside)

    def _load(self) -> _Content:
        return validate(read_json(self._path, "the state that servoctl commission wrote"), _Content, str(self._path))

    def _refuse_other_axis(self, axis: dict[str, Any]) -> None:
        for key in sorted(axis.keys() | self._content.axis.keys()):
            found, allowed = axis.get(key), self._content.axis.get(key)
            if found != allowed:
                inner, found, allowed = _difference(found, allowed)
                raise BadInput(
                    f"--out {self.folder}: {key}{inner}",
                    found,
                    f"{allowed}, whose commissioning is in this folder, or another folder",
                )

    def _refuse_edited_files(self, step: str, record: StepRecord) -> None:
        for name, sha256 in record.files_sha256.items():
            if file_sha256(self.folder / name) not in ("", sha256):
                raise BadInput(
                    f"--out {self.folder}: {name}",
                    f"a file that was changed after the step {step} had written it",
                    f"the file as it was; to have it made again, delete it or use --again {step}. Of a model or a set "
                    "of your own `servoctl synthesize`, `verify` and `deploy` make the same by single steps",
                )

    def _refuse_foreign_files(self, own_files: Sequence[str]) -> None:
        there = [name for name in own_files if (self.folder / name).exists()]
        if there:
            raise BadInput(f"--out {self.folder}", f"{', '.join(there)} without {STATE}", "an empty folder")

    def _write(self) -> None:
        write_file(self._path, self._content.model_dump_json(indent=1) + "\n")


@contextlib.contextmanager
def sole_walk(folder: Path) -> Iterator[None]:
    """Nobody else works in the folder meanwhile; the lock ends with the process. Raises Unreachable.

    A walk that was refused before it wrote anything leaves nothing: where there was no state, one alone is of no step.
    """
    try:
        lock = lock_folder(folder)
    except OSError as error:
        if not folder.is_dir():
            raise unwritable(f"--out {folder}", error) from None
        raise Unreachable(f"--out {folder}: another command is at work there") from None
    begun = is_there(folder / STATE)
    try:
        yield
    except (BadInput, Unreachable):
        with contextlib.suppress(OSError):  # not there, or not empty
            (folder / RECORDINGS).rmdir()
        with contextlib.suppress(OSError):
            if not begun and [entry.name for entry in folder.iterdir()] == [STATE]:
                (folder / STATE).unlink()
        raise
    finally:
        os.close(lock)


def digest(value: Any) -> str:
    """Hash of plain values in canonical form."""
    return hashlib.sha256(json.dumps(value, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def file_sha256(path: Path) -> str:
    """Hash of a file's bytes; empty when there is none."""
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.exists() else ""


#: Characters before the first difference of two texts that are shown with it, and in all.
_ALIKE_SHOWN, _TEXT_SHOWN = 20, 60


def _difference(one: Any, other: Any) -> tuple[str, str, str]:
    """Where two values that are not equal differ first: its dotted keys, and both sides there."""
    if isinstance(one, dict) and isinstance(other, dict):
        key = next(key for key in sorted({*one, *other}) if one.get(key) != other.get(key))
        inner, *sides = _difference(one.get(key), other.get(key))
        return f".{key}{inner}", sides[0], sides[1]
    texts = ["nothing" if value is None else str(value) for value in (one, other)]
    alike = next((i for i, (a, b) in enumerate(zip(*texts, strict=False)) if a != b), min(map(len, texts)))
    start = max(alike - _ALIKE_SHOWN, 0)
    return "", _cut(texts[0], start), _cut(texts[1], start)


def _cut(text: str, start: int) -> str:
    """A text from `start` on, at most _TEXT_SHOWN characters of it."""
    end = start + _TEXT_SHOWN
    return ("..." if start else "") + text[start:end] + ("..." if len(text) > end else "")
