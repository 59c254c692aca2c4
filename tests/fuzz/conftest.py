"""Targets for the tests of this folder, each made once."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import pytest

from tests.fuzz.target import Target, load


@pytest.fixture(scope="session")
def loaded(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Target]:
    """Targets by name."""
    return cache(lambda name: load(name, tmp_path_factory.mktemp(name[:8])))
