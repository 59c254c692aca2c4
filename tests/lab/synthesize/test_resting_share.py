"""How much of the feedback is left at rest: little where the loop stands it, more where friction falls steeply."""

from __future__ import annotations

from servod.formats.gains.gain_set import GainSet
from servod.formats.gains.parameters import LocalParameters
from servod.lab.synthesize.observer_width import SHARES, stands_at_rest, with_share_at_rest
from tests.lab.synthesize.designs import table1_set


def at_rest(within_rad: float | None, share: float) -> GainSet:
    """Table I's set with another rest."""
    gains = table1_set()
    changed = gains.parameters.model_copy(update={"rest_within_rad": within_rad, "rest_share": share})
    return gains.model_copy(update={"parameters": changed}).sealed()


def share_of(gains: GainSet) -> float | None:
    assert isinstance(gains.parameters, LocalParameters) and not gains.seal_broken
    return gains.parameters.rest_share


def test_the_papers_joint_rests_with_the_least_share() -> None:
    assert share_of(with_share_at_rest(table1_set())) == SHARES[0]


def test_a_joint_that_may_slide_at_rest_keeps_as_much_as_it_needs() -> None:
    """At 0.2 mrad a joint may slide with 0.1 rad/s before the law wakes, where its friction falls with speed."""
    found = with_share_at_rest(at_rest(2e-4, SHARES[0]))
    share = share_of(found)
    assert share is not None and share > SHARES[0]
    below = SHARES[SHARES.index(share) - 1]
    assert stands_at_rest(found) and not stands_at_rest(at_rest(2e-4, below))


def test_without_a_rest_there_is_nothing_to_choose() -> None:
    assert share_of(with_share_at_rest(at_rest(None, 1.0))) == SHARES[0]
