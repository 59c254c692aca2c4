"""A file of another kind is called by its name; what is wrong in a file of the wanted kind is the reader's to say."""

from __future__ import annotations

from pathlib import Path

import pytest

from servod.common.errors import BadInput
from servod.common.shipped import shipped
from servod.common.yaml import parse_yaml
from servod.formats.kinds import TELLING, FileKind, kind_of, require_kind


def test_no_key_tells_two_kinds() -> None:
    every = [key for keys in TELLING.values() for key in keys]
    assert len(every) == len(set(every))


@pytest.mark.parametrize("kind", FileKind)
@pytest.mark.parametrize("wanted", FileKind)
def test_every_other_kind_is_refused_by_name(kind: FileKind, wanted: FileKind) -> None:
    document = dict.fromkeys(TELLING[kind], 1)
    assert kind_of(document) is kind
    if kind is wanted:
        require_kind(document, wanted, "f.yaml")
        return
    with pytest.raises(BadInput) as caught:
        require_kind(document, wanted, "f.yaml")
    assert str(kind) in str(caught.value.found) and str(wanted) in caught.value.allowed


def test_one_key_of_its_own_makes_a_file_what_it_is_taken_for() -> None:
    document = {"parameters": {}, "inertia": 1.0, "friction": {}, "axis": "rotary"}
    require_kind(document, FileKind.GAINS, "f.yaml")
    for plain in ({}, {"nothing": 1}, [], None):
        require_kind(plain, FileKind.GAINS, "f.yaml")


@pytest.mark.parametrize(
    ("folder", "kind"), [("axes", FileKind.MODEL), ("config", FileKind.AXIS), ("", FileKind.GAINS)]
)
def test_what_ships_is_what_it_is(folder: str, kind: FileKind) -> None:
    files = sorted((Path(shipped("gains")) / folder).glob("*.yaml"))
    assert files and {kind_of(parse_yaml(file.read_text(), str(file))) for file in files} == {kind}
