"""Every input that once crashed, hung or ate the memory, handed in again: a file each, in its target's folder."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.fuzz.judge import judge
from tests.fuzz.target import TARGETS, Target

INPUTS = sorted((Path(__file__).parent / "regressions").glob("*/*"))


@pytest.mark.parametrize("file", INPUTS, ids=[f"{file.parent.name}-{file.stem}" for file in INPUTS])
def test_what_once_crashed_ends_as_documented(file: Path, loaded: Callable[[str], Target]) -> None:
    crash = judge(loaded(file.parent.name), file.read_bytes())
    assert crash is None, crash and crash.text


def test_every_folder_belongs_to_a_target() -> None:
    assert {file.parent.name for file in INPUTS} <= set(TARGETS)
    assert all(file.stat().st_size < 64 * 1024 for file in INPUTS)
