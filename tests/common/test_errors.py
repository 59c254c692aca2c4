"""Errors on their way from a worker process to its parent."""

from __future__ import annotations

import pickle

import pytest

from servod.client.axis import AxisDropped
from servod.common.errors import BadInput, ServodError, Unreachable
from servod.common.workers import worker_pool


def fail(error: ServodError) -> None:
    """What a worker does here."""
    raise error


ERRORS = [AxisDropped("FAULT", "too fast", b"rows"), BadInput("axis.yaml: bus", 7, "a bus"), Unreachable("gone")]


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
def test_an_error_of_a_worker_comes_to_its_parent_as_it_was(error: ServodError) -> None:
    again = pickle.loads(pickle.dumps(error))
    assert (type(again), str(again), again.__dict__) == (type(error), str(error), error.__dict__)


def test_a_worker_that_raises_one_is_none_that_died() -> None:
    with worker_pool(1) as pool, pytest.raises(AxisDropped, match="the axis went to FAULT"):
        pool.submit(fail, ERRORS[0]).result()
