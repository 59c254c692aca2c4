"""One daemon on a virtual axis for the tests of a file."""

from collections.abc import Iterator
from contextlib import closing

import pytest
from running import Running, SharedAxis, running


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SharedAxis[Running]]:
    with closing(SharedAxis(lambda: running(tmp_path_factory.mktemp("axis")))) as found:
        yield found


@pytest.fixture
def axis(shared: SharedAxis[Running]) -> Running:
    """The file's daemon, on an axis that can be enabled."""
    return shared.stands()
