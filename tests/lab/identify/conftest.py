"""One whole identification, shared by the tests that look at what came out of it."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import pytest

from servod.client.stepped import SteppedAxis
from servod.client.virtual import virtual_session
from servod.lab.identify.analysis import Analysis
from servod.lab.identify.walk import identify
from tests.lab.identify.joints import Drawn, draw


class Identification(NamedTuple):
    joint: Drawn
    analysis: Analysis
    recordings: Path
    axis: SteppedAxis
    told: list[tuple[str, float]]


def identify_joint(joint: Drawn, folder: Path, seed: int = 1) -> Identification:
    axis = SteppedAxis(virtual_session(joint.model, folder, joint.encoder_counts, seed), folder)
    told: list[tuple[str, float]] = []
    analysis = identify(axis, folder / "recordings", lambda what, share: told.append((what, share)), seed=seed)
    return Identification(joint, analysis, folder / "recordings", axis, told)


@pytest.fixture(scope="session")
def fine(tmp_path_factory: pytest.TempPathFactory) -> Identification:
    """A joint of Table I's size with a 20 bit encoder."""
    return identify_joint(draw(21, bits=20), tmp_path_factory.mktemp("fine"))


@pytest.fixture(scope="session")
def coarse_and_large(tmp_path_factory: pytest.TempPathFactory) -> Identification:
    """A joint of 100 times the size with a 17 bit encoder."""
    return identify_joint(draw(22, size=100.0, bits=17), tmp_path_factory.mktemp("large"))
