"""The whole walk cut in every one of its steps, against one that nothing interrupted: the same answers."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from servod.client.open import VirtualWalkAxis
from servod.common.progress import OnProgress
from servod.lab.commission import report
from servod.lab.commission.state import (
    AFTER_ROWS,
    BEFORE_ROWS,
    CERTIFICATE,
    DEPLOYMENT,
    DESIGN,
    GAINS,
    IDENTIFIED,
    MODEL,
    REPORT,
    TRACKING,
    TUNING,
    file_sha256,
)
from servod.lab.commission.steps import STEPS, rivals, validate
from servod.lab.commission.walk import Questions, Step, Walk, WalkOptions, run
from tests.lab.synthesize.designs import table1

AXIS = VirtualWalkAxis(table1(), seed=1)
#: What a walk answers with; its recordings and its page bear times.
ANSWERS = (MODEL, IDENTIFIED, DESIGN, GAINS, CERTIFICATE, DEPLOYMENT, TUNING, TRACKING)


def walk_in(folder: Path, told: list[str], cut: str = "") -> Walk:
    """A walk on a small scale; the step with the title `cut` is interrupted as soon as it has done something."""

    @contextmanager
    def progress(title: str) -> Iterator[OnProgress]:
        def on_progress(_what: str, share: float) -> None:
            if title == cut and share > 0.0:
                raise KeyboardInterrupt

        yield on_progress

    folder.mkdir(exist_ok=True)
    options = WalkOptions(plants=2, processes=1, least_plants=2, budget=6)
    return Walk(folder, AXIS, options, Questions(True, lambda _q: True), progress, told.append)


@pytest.fixture
def few_rivals(monkeypatch: pytest.MonkeyPatch) -> None:
    """One rival in each class: the walk is what is tested."""
    for module in (rivals, validate):
        monkeypatch.setattr(module, "CONTENDERS", ("pd",))


@pytest.mark.long
@pytest.mark.timeout(1800)  # a minute and a half of a core that has nothing else to do
@pytest.mark.usefixtures("few_rivals")
def test_cut_in_every_step_the_walk_ends_in_the_same_place(tmp_path: Path) -> None:
    """The experiments, half of the time, run to their end once: what they leave is where both walks go on."""
    told: list[str] = []
    cut_off(tmp_path / "first", STEPS[0])
    whole = walk_in(tmp_path / "whole", told)
    run(whole, STEPS[:1])
    shutil.copytree(whole.folder, tmp_path / "cut")
    document = report.result(whole, run(whole, STEPS))
    assert [line.split(": ")[1] for line in told if line.endswith(" s")] == [step.title for step in STEPS]
    for step in STEPS[1:]:
        cut_off(tmp_path / "cut", step)
    again = walk_in(tmp_path / "cut", told)
    taken_up = report.result(again, run(again, STEPS))
    assert told[-len(STEPS) - 1 : -2] == [
        f"step {k} of {len(STEPS)}: {step.title}: done before" for k, step in enumerate(STEPS[:-1], 1)
    ]
    assert answers(again.folder) == answers(whole.folder)
    assert without_times(taken_up) == without_times(document)
    for name in (REPORT, BEFORE_ROWS, AFTER_ROWS):
        assert again.path(name).stat().st_size > 10_000


def cut_off(folder: Path, step: Step) -> None:
    """Walk until `step`, which is interrupted and leaves no answer."""
    walk = walk_in(folder, [], cut=step.title)
    with pytest.raises(KeyboardInterrupt):
        run(walk, STEPS)
    assert not walk.path(step.outputs(walk)[0]).exists(), step.name


def answers(folder: Path) -> dict[str, Any]:
    """Hashes of what the walk answered."""
    return {name: file_sha256(folder / name) for name in ANSWERS}


def without_times(document: dict[str, Any]) -> dict[str, Any]:
    """What of a walk's document is the same in every folder and at every speed."""
    return {key: value for key, value in document.items() if key not in ("seconds", "files")}
