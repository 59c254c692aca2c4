"""A joint that stands where it shall is left to its bristle: how the local law comes to rest, and wakes again."""

from __future__ import annotations

from itertools import pairwise

import pytest

from servod.controllers import LAWS, local
from servod.controllers.state import ASKED, DISTURBANCE, REST
from tests.controllers.cases import fresh_state, local_parameters

DT = 0.001
WITHIN, SHARE = 2e-5, 0.3
RESTING = local_parameters(rest=(WITHIN, SHARE), bandwidth=50.0)
ALWAYS_AWAKE = local_parameters(bandwidth=50.0)


def feedback(p: tuple[float, ...], s: list[float], error: float, v_ref: float = 0.0, a_ref: float = 0.0) -> float:
    """Feedback of one step at this error, with all torque applied."""
    return LAWS["local"].step(p, s, error, v_ref, a_ref, 0.0, v_ref, s[ASKED], DT)[1]


def rested() -> list[float]:
    """State after a second within the width."""
    s = fresh_state("local")
    for _ in range(1000):
        feedback(RESTING, s, 0.9 * WITHIN)
    return s


def test_at_rest_the_stated_share_of_the_feedback_is_left() -> None:
    s = rested()
    assert s[REST] == pytest.approx(1.0)
    assert feedback(RESTING, s, 0.9 * WITHIN) == pytest.approx(SHARE * 2.5 * 0.9 * WITHIN)


def test_at_rest_the_observer_learns_by_that_share_more_slowly() -> None:
    calm, awake = rested(), fresh_state("local")
    calm[DISTURBANCE] = 0.0
    for p, s in ((RESTING, calm), (ALWAYS_AWAKE, awake)):
        for _ in range(3):
            LAWS["local"].step(p, s, 0.0, 0.0, 0.0, 1e-5, 0.0, 0.01, DT)
    assert 0.0 < calm[DISTURBANCE] < 1.1 * SHARE * awake[DISTURBANCE]


def test_one_reading_beyond_the_width_wakes_a_little_and_a_push_wakes_within_milliseconds() -> None:
    s = rested()
    feedback(RESTING, s, 2.0 * WITHIN)
    assert 0.7 < s[REST] < 0.85
    for _ in range(15):
        feedback(RESTING, s, 2.0 * WITHIN)
    assert feedback(RESTING, s, 2.0 * WITHIN) == pytest.approx(2.5 * 2.0 * WITHIN, rel=0.02)


@pytest.mark.parametrize("motion", [(0.1, 0.0), (0.0, 1.0)])
def test_a_reference_that_moves_wakes_within_milliseconds_and_without_a_jump(motion: tuple[float, float]) -> None:
    s, error, courses = rested(), 0.9 * WITHIN, []
    before, whole = feedback(RESTING, s, error), 2.5 * error
    for _ in range(20):
        courses.append(feedback(RESTING, s, error, *motion))
    steps = [after - earlier for earlier, after in pairwise([before, *courses])]
    assert 0.0 < max(steps) < 0.25 * (whole - before)
    assert courses[-1] == pytest.approx(whole, rel=0.01)


def test_without_a_width_nothing_rests() -> None:
    s = fresh_state("local")
    for _ in range(1000):
        assert feedback(ALWAYS_AWAKE, s, 0.0) == 0.0
    assert s[REST] == 0.0
    assert local_parameters()[local.REST_WITHIN] == 0.0


def learned(v_ref: float, low_bandwidth: float) -> float:
    """Estimate after three steps at a torque that moves nothing, creeping in Omega_L."""
    p, s = list(local_parameters(bandwidth=50.0)), fresh_state("local")
    p[local.OBSERVER_LOW] = low_bandwidth
    for _ in range(3):
        LAWS["local"].step(tuple(p), s, 1e-3, v_ref, 0.0, 0.0, v_ref, 0.01, DT)
    return s[DISTURBANCE]


def test_the_observer_for_coming_to_rest_waits_for_a_reference_that_rests() -> None:
    assert learned(0.0, 500.0) > 5.0 * learned(0.0, 50.0) > 0.0
    assert learned(1e-4, 500.0) == learned(1e-4, 50.0) != 0.0
