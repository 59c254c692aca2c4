"""When a term is worth a name although the model's own parameters take up most of it."""

from __future__ import annotations

import pytest

from servod.lab.diagnose.select.merit import Merit, worth_naming


@pytest.mark.parametrize(
    ("of_left", "torque", "own", "worth"),
    [
        *((0.99, 0.025, 0.1, True), (0.99, 0.025, 0.02, False), (0.5, 0.025, 0.1, False)),
        *((0.99, 0.015, 0.1, True), (0.99, 0.015, 0.02, False), (0.99, 0.005, 0.1, False)),
    ],
)
def test_what_takes_nearly_all_counts_by_its_own_torque(of_left: float, torque: float, own: float, worth: bool) -> None:
    assert worth_naming(Merit(0.002, of_left, torque, 6e4, own), level=False) is worth


@pytest.mark.parametrize(("of_left", "worth"), [(-0.03, False), (0.05, True)])
def test_what_takes_blows_alone_is_no_finding(of_left: float, worth: bool) -> None:
    """A joint that breaks loose leaves blows: a push that takes some of them leaves the rows between as they were."""
    assert worth_naming(Merit(0.41, of_left, 0.45, 1e3, 0.45), level=False) is worth
