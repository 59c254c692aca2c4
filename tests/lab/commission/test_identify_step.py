"""The step that identifies a real axis: it goes on where it was interrupted, and begins again when it is asked to."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from servod.client.axis import AxisClient
from servod.client.open import VirtualWalkAxis
from servod.client.stepped import SteppedAxis
from servod.lab.commission.state import RECORDINGS
from servod.lab.commission.steps.identify import Identify
from servod.lab.commission.walk import run
from servod.lab.identify.store import load
from tests.lab.commission.test_state import walk
from tests.lab.synthesize.designs import table1


class Cut(SteppedAxis):
    """Brings Ctrl-C when so many motions have run."""

    motions = 0

    def run(self, *arguments: Any) -> Any:
        if self.motions == 0:
            raise KeyboardInterrupt
        self.motions -= 1
        return super().run(*arguments)


@dataclass(frozen=True)
class Real(VirtualWalkAxis):
    """Taken for a real axis; its experiments are cut short."""

    virtual: bool = False
    motions: int = 0

    @property
    def identity(self) -> dict[str, Any]:
        return {"axis": "real"}

    @contextlib.contextmanager
    def experiments(self) -> Iterator[AxisClient]:
        with super().experiments() as axis, tempfile.TemporaryDirectory() as folder:
            assert isinstance(axis, SteppedAxis)
            cut = Cut(axis.session, Path(folder))
            cut.motions = self.motions
            yield cut


def recorded(folder: Path, motions: int, **options: Any) -> list[str]:
    """Hashes of the recordings after a walk of which so many motions run."""
    with pytest.raises(KeyboardInterrupt):
        run(walk(folder, Real(table1(), seed=1, motions=motions), **options), (Identify(),))
    return [trace.sha256 for trace in load(folder / RECORDINGS)]


def test_a_real_axis_goes_on_where_it_was_interrupted(tmp_path: Path) -> None:
    first = recorded(tmp_path, 1)
    assert len(first) == 1
    assert recorded(tmp_path, 1)[:1] == first
    assert len(recorded(tmp_path, 0)) == 2


def test_a_real_axis_is_measured_anew_when_that_is_asked_for(tmp_path: Path) -> None:
    before = recorded(tmp_path, 2)
    assert len(before) == 2
    assert len(recorded(tmp_path, 1, again=("identify",))) == 1
    assert [trace.sha256 for trace in load(tmp_path / RECORDINGS / "before_01")] == before
