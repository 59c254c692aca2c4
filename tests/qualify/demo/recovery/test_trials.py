"""A set that is turned down while the loop does not keep time is put on trial again, and no other."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from servod.lab.deploy.outcome import Ending
from servod.lab.recordings.recording import ROW
from servod.qualify.demo.recovery import walk


class Trial:
    """What `deploy` gave, as far as the walk looks at it."""

    def __init__(self, ending: Ending, missed: int | None) -> None:
        self.proven = ending is Ending.KEPT
        self.rows_after = None
        if missed is not None:
            self.rows_after = np.zeros(2, ROW)
            self.rows_after["missed"][1] = missed


@pytest.mark.parametrize(
    ("trials", "used"),
    [
        ([Trial(Ending.KEPT, 7)], 1),
        ([Trial(Ending.ROLLED_BACK, 0), Trial(Ending.KEPT, 0)], 1),
        ([Trial(Ending.ROLLED_BACK, None), Trial(Ending.KEPT, 0)], 1),
        ([Trial(Ending.ROLLED_BACK, 3), Trial(Ending.KEPT, 0)], 2),
        ([Trial(Ending.ROLLED_BACK, 1) for _ in range(9)], 3),
    ],
)
def test_only_lateness_earns_another_trial(trials: list[Trial], used: int, monkeypatch: pytest.MonkeyPatch) -> None:
    left = iter(trials)

    def deploy(_axis: Any, _gains: Any, on_progress: walk.OnProgress) -> Trial:
        on_progress("verdict", 1.0)
        return next(left)

    monkeypatch.setattr(walk, "deploy", deploy)
    told: list[str] = []
    done = walk._deployed(None, None, lambda what, _share: told.append(what))  # type: ignore[arg-type]
    assert done is trials[used - 1]
    assert len(told) == used
