"""The step that deploys on an axis that remembers: interrupted after the set was kept, and taken up."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from servod.client.axis import LOOK_S, AxisClient, AxisReading, ReferenceMotion, Watch
from servod.client.open import VirtualWalkAxis
from servod.formats.config import AxisConfig
from servod.formats.gains.gain_set import GainSet, Promise, parse_gains
from servod.formats.gains.store import GainStore
from servod.formats.model.axis_model import axis_model_yaml
from servod.lab.commission.comparison import load_rows
from servod.lab.commission.report import sections
from servod.lab.commission.state import AFTER_ROWS, BEFORE, BEFORE_ROWS, DEPLOYMENT, GAINS, MODEL, write_text
from servod.lab.commission.state import read_walk_json as read_json
from servod.lab.commission.steps.deploy import Deploy, remembered
from servod.lab.commission.walk import run
from servod.lab.recordings.recording import ROW, Rows
from servod.lab.report.figure import PageTable
from servod.lab.verify.validation import STEP_S, Array
from tests.formats.gains import good
from tests.lab.commission.test_state import walk
from tests.lab.synthesize.designs import table1


def promising() -> GainSet:
    """A certified set; on the axis here it does what it promises."""
    gains = good.certified(parse_gains(good.PD, "good.yaml"))
    assert gains.certificate is not None
    promised = Promise(slow_rad=1e-5, brisk_rad=1e-5, hold_rad=1e-5, plants=2)
    return gains.model_copy(
        update={"certificate": gains.certificate.model_copy(update={"promised": promised})}
    ).sealed()


NEW = promising()


@dataclass
class Remembers:
    """An axis that follows with one encoder count of error under the new set and with many under any other.

    Its store outlasts its clients, as a daemon's does; `cut` interrupts the client when a set has just been kept.
    """

    config: AxisConfig
    store: GainStore
    cut: bool
    enabled: bool = True
    tried: tuple[str, int] | None = None
    offset_ns: int | None = 0

    @property
    def active(self) -> tuple[str, int]:
        stored = self.store.active()
        assert stored is not None
        return self.tried or (stored.name, stored.version)

    def status(self) -> AxisReading:
        return AxisReading("ENABLED" if self.enabled else "DISABLED", False, 0.0, 0.0)

    def run(self, motion: ReferenceMotion, watch: Watch | None = None, look_s: float = LOOK_S) -> bytes:
        words = motion.arguments
        held = np.full(round(1000 * STEP_S), max(0.0, words.get("amplitude_rad", 0.0)))
        path = np.array(words["positions_rad"]) if "positions_rad" in words else held
        return rows_of(path, 6e-6 if self.active[0] == NEW.name else 6e-3).tobytes()

    def begin(self, motion: ReferenceMotion) -> None:
        """Nobody begins a motion and leaves it here."""

    def wait(self, duration_s: float) -> None:
        """Nothing moves meanwhile."""

    def load(self, gains: GainSet) -> tuple[str, int]:
        stored = self.store.load(gains.to_yaml(), gains.name)
        return stored.name, stored.version

    def activate(self, name: str, version: int) -> None:
        self.tried = (name, version)

    def keep(self, note: str, figures: dict[str, float]) -> None:
        self.store.activate(*self.active, note, figures)
        self.tried = None
        if self.cut:
            raise KeyboardInterrupt

    def give_up(self, note: str, figures: dict[str, float]) -> None:
        assert self.tried is None, (note, figures)

    def enable(self, reset_fault: bool = False) -> None:
        self.enabled = True

    def disable(self) -> None:
        self.enabled = False

    stop = disable


def rows_of(reference_rad: Array, error_rad: float) -> Rows:
    """One motion that is followed with an alternating error, and a cycle of rest behind it."""
    rows = np.zeros(len(reference_rad) + 1, dtype=ROW)
    rows["cycle"] = np.arange(len(rows))
    rows["reference_active"][:-1] = 1
    rows["reference_rad"][:-1] = reference_rad
    rows["position_rad"][:-1] = reference_rad + error_rad * (-1.0) ** np.arange(len(reference_rad))
    return rows


@dataclass(frozen=True)
class Lasting(VirtualWalkAxis):
    """An axis under a daemon, as the walk sees it."""

    cut: bool = False
    virtual: bool = False

    @contextlib.contextmanager
    def deployment(self, folder: Path, gains: GainSet, present: GainSet) -> Iterator[AxisClient]:
        store = GainStore(folder)
        if store.active() is None:
            store.load(present.to_yaml(), present.name)
            store.activate(present.name)
        yield Remembers(self.with_filter_for(gains), store, self.cut)


AXIS, CUT = Lasting(table1(), seed=1), Lasting(table1(), seed=1, cut=True)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A walk's folder with what the steps before leave."""
    write_text(tmp_path / MODEL, axis_model_yaml(table1()))
    write_text(tmp_path / GAINS, NEW.to_yaml())
    return tmp_path


def test_a_kept_set_is_compared_with_what_ran_before_it_when_the_step_is_taken_up(folder: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        run(walk(folder, CUT), (Deploy(),))
    assert not (folder / DEPLOYMENT).exists()
    for again in ((), ("deploy",)):
        run(walk(folder, AXIS, again=again), (Deploy(),))
        found = read_json(folder / DEPLOYMENT)
        assert (found["outcome"], found["present"]["name"]) == ("confirmed", "identification")
        assert (found["after"]["slow_mrad"], found["before"]["slow_mrad"]) == pytest.approx((0.006, 6.0), rel=1e-3)
        assert len(load_rows(folder / BEFORE_ROWS)) == len(load_rows(folder / AFTER_ROWS)) > 12_000
    write_text(folder / GAINS, NEW.model_copy(update={"description": "another"}).sealed().to_yaml())
    assert remembered(walk(folder, AXIS)) is None


def test_a_set_that_was_active_before_the_walk_has_nothing_before_it(folder: Path) -> None:
    with AXIS.deployment(folder / "store", NEW, NEW) as link:
        assert link.active == (NEW.name, 1)
    here = walk(folder, AXIS)
    run(here, (Deploy(),))
    assert not (folder / BEFORE).exists() and not (folder / BEFORE_ROWS).exists()
    table, said = sections(here, NEW, table1())["Deployment"]()
    assert isinstance(table, PageTable) and table.header == ("figure", "after", "promised")
    assert isinstance(said, str) and "promise alone" in said
