"""A fast observer in slow motion: taken where plants follow with it, refused where it throws them forward."""

from __future__ import annotations

import math

import pytest

from servod.formats.gains.gain_set import GainSet
from servod.formats.gains.parameters import LocalParameters, VelocitySource
from servod.lab.synthesize import observer_width
from servod.lab.synthesize.observer_width import (
    follows,
    with_moving_observer,
    with_observer,
    with_returning_velocity,
)
from servod.lab.verify.steady_friction import steady_friction
from tests.lab.synthesize.designs import table1_set


def with_bandwidths(high: float, rest: float | None, moving: float | None = None) -> GainSet:
    """Table I's set with other bandwidths [rad/s]."""
    gains = table1_set()
    assert isinstance(gains.parameters, LocalParameters)
    return gains.model_copy(update={"parameters": with_observer(gains.parameters, high, rest, moving)}).sealed()


def moving_bandwidth(gains: GainSet) -> float | None:
    assert gains.design is not None
    found = with_moving_observer(gains, steady_friction(gains.design.model))
    assert found.seal is not None and not found.seal_broken
    assert isinstance(found.parameters, LocalParameters) and found.parameters.disturbance_observer is not None
    return found.parameters.disturbance_observer.low_moving_bandwidth_rad_s


def test_the_papers_joint_moves_with_an_observer_between_those_of_both_regions() -> None:
    observer = table1_set().parameters.disturbance_observer  # type: ignore[union-attr]
    assert observer is not None and observer.low_bandwidth_rad_s is not None
    bare = with_bandwidths(observer.bandwidth_rad_s, observer.low_bandwidth_rad_s)
    half_way = math.sqrt(observer.low_bandwidth_rad_s * observer.bandwidth_rad_s)
    assert moving_bandwidth(bare) == pytest.approx(half_way)


def test_with_a_coarse_encoder_one_that_throws_the_joint_is_not_taken() -> None:
    gains = with_bandwidths(80.0, 1500.0)
    assert gains.design is not None and follows(with_bandwidths(80.0, 1500.0, 1500.0))
    coarse = gains.model_copy(update={"design": gains.design.model_copy(update={"counts_per_turn": 2.0**17})}).sealed()
    assert moving_bandwidth(coarse) == 80.0


def test_without_a_bandwidth_for_rest_there_is_nothing_to_choose() -> None:
    assert moving_bandwidth(with_bandwidths(30.0, None)) is None


@pytest.mark.parametrize("first", [True, False])
def test_the_velocity_that_comes_back_is_taken(first: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whichever the simulated pushes tell; neither leaves the one that was wished."""
    gains = table1_set()

    def source(found: GainSet) -> VelocitySource:
        assert isinstance(found.parameters, LocalParameters) and not found.seal_broken
        return found.parameters.friction.velocity

    back = {VelocitySource.CORRECTED_REFERENCE: first, VelocitySource.REFERENCE: not first}
    monkeypatch.setattr(observer_width, "returns", lambda found, _: back[source(found)])
    wished = VelocitySource.CORRECTED_REFERENCE
    assert source(with_returning_velocity(gains)) is (wished if first else VelocitySource.REFERENCE)
    monkeypatch.setattr(observer_width, "returns", lambda *_: False)
    assert source(with_returning_velocity(gains)) is wished
