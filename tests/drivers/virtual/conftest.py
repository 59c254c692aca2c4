from __future__ import annotations

import pytest

from tests.drivers.virtual.bench import Bench


@pytest.fixture
def bench() -> Bench:
    return Bench()
