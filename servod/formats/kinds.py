"""Which kind of file a YAML document is, told by its keys: a file of another kind is called by its name.

Under every reader of such a file. The readers themselves name the first wrong key; of a file that was taken for another
one that says nothing.
"""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Any, TypeVar

from servod.common.errors import BadInput
from servod.common.yaml import Strict, parse_yaml, read_text, validate

M = TypeVar("M", bound=Strict)


class FileKind(StrEnum):
    """The YAML files that servod reads."""

    AXIS = "axis configuration"
    GAINS = "gain set"
    MODEL = "axis model"
    MAP = "column map"


#: Keys that tell a kind; a key that two kinds have tells neither.
TELLING: dict[FileKind, frozenset[str]] = {
    FileKind.AXIS: frozenset(
        {"bus", "cycle", "heartbeat", "amplifier", "encoder", "limits", "gains", "control", "recorder", "metrics"}
    ),
    FileKind.GAINS: frozenset({"schema_version", "parameters", "provenance", "certificate", "description"}),
    FileKind.MODEL: frozenset({"axis", "inertia", "friction", "delay_s", "gravity", "torque_offset"}),
    FileKind.MAP: frozenset({"columns"}),
}


def kind_of(document: dict[Any, Any]) -> FileKind | None:
    """The kind whose telling keys the document has most of; None where it has none of any."""
    hits = _hits(document)
    kind = max(hits, key=hits.__getitem__)
    return kind if hits[kind] else None


def require_kind(document: Any, wanted: FileKind, where: str) -> None:
    """Refuse a document that is plainly a file of another kind. Raises BadInput; wrong keys are the reader's to find.

    >>> require_kind({"inertia": 0.001, "friction": {}}, FileKind.GAINS, "model.yaml")
    Traceback (most recent call last):
    servod.common.errors.BadInput: model.yaml: found an axis model; allowed: a gain set
    """
    if not isinstance(document, dict):
        return
    kind = kind_of(document)
    if kind not in (None, wanted) and _hits(document)[wanted] == 0:
        raise BadInput(where, _named(kind), _named(wanted))


def load_kind(path: str | Path, wanted: FileKind, model: type[M]) -> M:
    """Read the file at `path`, of the kind that is wanted, as `model`. Raises BadInput (file, key, found, allowed)."""
    document = parse_yaml(read_text(path), str(path))
    require_kind(document, wanted, str(path))
    return validate(document, model, str(path))


def _hits(document: dict[Any, Any]) -> dict[FileKind, int]:
    return {kind: len(keys & set(document)) for kind, keys in TELLING.items()}


def _named(kind: FileKind | None) -> str:
    return f"{'an' if str(kind).startswith('a') else 'a'} {kind}"
