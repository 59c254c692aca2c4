"""A recovery on the wall clock that takes more than its one try is found, but where the processes were starved."""

from __future__ import annotations

from typing import Any

import pytest

from servod.formats.protocol import Verb
from servod.qualify.faults.scenario import Recovery
from servod.qualify.soak.tally import Findings, Tally, Wrong
from servod.qualify.soak.wall_clock import WallSoak


class StoppedAxis:
    """The user's side of an axis that some fault stopped; it is enabled again after so many tries."""

    refusal = ""

    def __init__(self, tries: int) -> None:
        self._left = tries
        self.client = self

    def call(self, _verb: Verb) -> dict[str, Any]:
        state = "FAULT" if self._left else "ENABLED"
        return {"axis": {"state": state}, "faults": [{"code": "FOLLOWING_ERROR"}] if self._left else []}

    def recover(self, _recovery: Recovery) -> bool:
        self._left -= 1
        return not self._left

    def now_ns(self) -> int:
        return 0


@pytest.mark.parametrize(
    ("recovery", "tries", "starved", "found"),
    [
        (Recovery.NONE, 0, False, ""),
        (Recovery.NONE, 1, False, "not by none, but at try 2 of 3: FOLLOWING_ERROR"),
        (Recovery.NONE, 1, True, ""),
        (Recovery.RESET_FAULT, 1, False, ""),
        (Recovery.RESET_FAULT, 2, False, "not by reset_fault, but at try 2 of 3: FOLLOWING_ERROR"),
        (Recovery.RESET_FAULT, 2, True, ""),
    ],
)
def test_another_try_is_found(
    monkeypatch: pytest.MonkeyPatch, recovery: Recovery, tries: int, starved: bool, found: str
) -> None:
    soak = WallSoak.__new__(WallSoak)  # its processes are not asked here
    soak.findings, soak.tally = Findings(), Tally()
    for name, value in (("_axis", StoppedAxis(tries)), ("_settle", lambda: None), ("_watched", dict)):
        monkeypatch.setattr(soak, name, value, raising=False)
    starvation = type("Starving", (), {"is_starved": lambda _self, _processes: starved})()
    monkeypatch.setattr(soak, "_starvation", starvation, raising=False)
    first = (recovery is Recovery.NONE and tries == 0) or (recovery is not Recovery.NONE and tries == 1)
    assert soak._recover(recovery) is first
    assert [finding.text for finding in soak.findings.anomalies] == [found] * bool(found)
    assert set(soak.findings.counts) == ({Wrong.NOT_RECOVERED} if found else set())
    assert soak.tally.excused.total() == (starved and not first)
