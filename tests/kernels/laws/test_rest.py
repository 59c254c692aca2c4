"""A joint that stands where it shall is left to its bristle: how the local law comes to rest, and wakes again."""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from servod.formats.gains.parameters import LocalParameters
from servod.kernels.laws import LAWS, local
from servod.kernels.laws.state import LawState
from servod.lab.simulate.simulate import LoopSettings, simulate_closed_loop
from tests.kernels.laws.cases import local_gains
from tests.lab.synthesize.designs import table1, table1_set

DT = 0.001
WITHIN, SHARE = 2e-5, 0.3
RESTING = local_gains(rest=(WITHIN, SHARE), bandwidth=50.0)
ALWAYS_AWAKE = local_gains(bandwidth=50.0)


def feedback(p: local.LocalGains, s: LawState, error: float, v_ref: float = 0.0, a_ref: float = 0.0) -> float:
    """Feedback of one step at this error, with all torque applied."""
    return LAWS["local"].step(p, s, error, v_ref, a_ref, 0.0, v_ref, s.asked, DT)[1]


def rested() -> LawState:
    """State after a second within the width."""
    s = LawState()
    for _ in range(1000):
        feedback(RESTING, s, 0.9 * WITHIN)
    return s


def test_at_rest_the_stated_share_of_the_feedback_is_left() -> None:
    s = rested()
    assert s.rest == pytest.approx(1.0)
    assert feedback(RESTING, s, 0.9 * WITHIN) == pytest.approx(SHARE * 2.5 * 0.9 * WITHIN)


def test_at_rest_the_observer_learns_by_that_share_more_slowly() -> None:
    calm, awake = rested(), LawState()
    calm.d_hat = 0.0
    for p, s in ((RESTING, calm), (ALWAYS_AWAKE, awake)):
        for _ in range(3):
            LAWS["local"].step(p, s, 0.0, 0.0, 0.0, 1e-5, 0.0, 0.01, DT)
    assert 0.0 < calm.d_hat < 1.1 * SHARE * awake.d_hat


def test_one_reading_beyond_the_width_wakes_a_little_and_a_push_wakes_within_milliseconds() -> None:
    s = rested()
    feedback(RESTING, s, 2.0 * WITHIN)
    assert 0.7 < s.rest < 0.85
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
    s = LawState()
    for _ in range(1000):
        assert feedback(ALWAYS_AWAKE, s, 0.0) == 0.0
    assert s.rest == 0.0
    assert local_gains().rest_within == 0.0


def learned(v_ref: float, at_rest: float, moving: float) -> float:
    """Estimate after three steps at a torque that moves nothing, creeping in Omega_L."""
    p, s = local_gains(bandwidth=50.0)._replace(observer_low=at_rest, observer_moving=moving), LawState()
    for _ in range(3):
        LAWS["local"].step(p, s, 1e-3, v_ref, 0.0, 0.0, v_ref, 0.01, DT)
    return s.d_hat


def test_the_observer_has_a_bandwidth_for_coming_to_rest_and_one_for_motion() -> None:
    assert learned(0.0, 500.0, 50.0) > 5.0 * learned(0.0, 50.0, 50.0) > 0.0
    assert learned(0.0, 50.0, 500.0) == learned(0.0, 50.0, 50.0)
    assert learned(1e-4, 500.0, 50.0) == learned(1e-4, 50.0, 50.0) != 0.0
    assert learned(1e-4, 50.0, 500.0) > 5.0 * learned(1e-4, 50.0, 50.0)


@cache
def held(rests: bool, push_nm: float = 0.0) -> np.ndarray:
    """True position over six seconds of hold with a noisy 20 bit encoder; pushed from the third second on."""
    gains = table1_set()
    parameters = gains.parameters
    assert isinstance(parameters, LocalParameters) and gains.design is not None
    width = {"rest_within_rad": 1.4e-5 if rests else None, "rest_share": SHARE if rests else None}
    cycles = 6000
    run = simulate_closed_loop(
        table1(),
        LAWS["local"],
        parameters.model_copy(update=width).pack(),
        np.zeros((cycles, 3)),
        LoopSettings(DT, 2.0**20, gains.design.velocity_cutoff_hz, 1.0),
        external_nm=np.where(np.arange(cycles) >= 3000, push_nm, 0.0),
        reading_rad=np.random.default_rng(5).normal(0.0, 2e-6, cycles),
    )
    return run.position_rad


def test_a_joint_at_rest_is_clearly_quieter_than_one_that_answers_every_reading() -> None:
    assert np.ptp(held(True)[3000:]) < 0.6 * np.ptp(held(False)[3000:])


def test_a_push_is_answered_as_far_and_as_fast_as_without_rest() -> None:
    resting, awake = held(True, 0.04), held(False, 0.04)
    assert np.abs(resting).max() < 1.25 * np.abs(awake).max()
    assert np.abs(resting[-1000:]).max() < 1.4e-5 + 1e-5
