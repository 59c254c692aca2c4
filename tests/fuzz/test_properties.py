"""What is drawn from each target's strategy, a few inputs of each: nothing but documented errors.

`python -m tests.fuzz.run` draws as many as one has time for.
"""

from __future__ import annotations

from collections.abc import Callable

import pytest
from hypothesis import HealthCheck, Phase, given, seed, settings

from tests.fuzz.judge import judge
from tests.fuzz.target import TARGETS, Target

EXAMPLES = 12


@pytest.mark.parametrize("name", TARGETS)
def test_drawn_inputs_end_as_documented(name: str, loaded: Callable[[str], Target]) -> None:
    target = loaded(name)

    @seed(1)
    @settings(
        database=None,
        deadline=None,
        max_examples=EXAMPLES,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(target.shape)
    def drawn(data: bytes) -> None:
        crash = judge(target, data)
        assert crash is None, crash and crash.text

    drawn()
    for good in target.seeds:
        assert judge(target, good) is None
