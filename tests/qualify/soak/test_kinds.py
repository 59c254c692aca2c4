"""Whatever a soak draws is an injection that the campaign's actions take."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from typing import Any

import pytest

from servod.qualify.faults.actions import action_of
from servod.qualify.faults.scenario import Runs
from servod.qualify.soak.kinds import KINDS, InjectionKind


class End(random.Random):
    """Draws one end of every range."""

    def __init__(self, end: Callable[[Any, Any], Any]) -> None:
        super().__init__(0)
        self._end = end

    def randint(self, a: int, b: int) -> int:
        return self._end(a, b)

    def choice(self, seq: Sequence[Any]) -> Any:
        return seq[self._end(0, len(seq) - 1)]


@pytest.mark.parametrize("end", [min, max])
@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_both_ends_of_every_range_are_taken(kind: InjectionKind, end: Callable[[Any, Any], Any]) -> None:
    action_of(kind.injection(End(end)), kind.name, Runs.STEPPED)
    if (repair := kind.repair()) is not None:
        action_of(repair, kind.name, Runs.STEPPED)


def test_the_values_between_the_ends_are_taken() -> None:
    for kind in KINDS:
        for seed in range(20):
            action_of(kind.injection(random.Random(seed)), kind.name, Runs.STEPPED)
