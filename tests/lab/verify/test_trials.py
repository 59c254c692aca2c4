"""Motions and plants of the Monte-Carlo: noise that was identified, a fall that varies, sizes that follow the axis."""

from __future__ import annotations

import numpy as np
import pytest

from servod.common.yaml import validate
from servod.formats.model.axis_model import AxisModel, LocalFriction
from servod.lab.simulate.noise import IDENTIFIED_HZ, noise_of
from servod.lab.verify.plants import scaled
from servod.lab.verify.steady_friction import steady_friction
from servod.lab.verify.trials import LARGE_STEP_S, hold_ripple, quiet, run_sample, scale_of, trial_motion
from tests.lab.synthesize.designs import table1, table1_set
from tests.lab.synthesize.test_intervals import identified


def noisy() -> AxisModel:
    """An identified joint with the noise that was measured on it."""
    model = identified(0.01, 1e-4)
    assert model.identified is not None
    plain = model.model_dump(mode="json", exclude_none=True)
    for name, value in (("torque_noise_rms", 1e-3), ("encoder_noise_rms", 3e-6)):
        plain["identified"]["values"][name] = {"value": value, "low": value, "high": value, "unit": "SI"}
    return validate(plain, AxisModel, "noisy")


def test_the_fall_of_a_measured_map_varies_about_its_level() -> None:
    model = identified(0.01, 1e-4)
    steeper = scaled(model, {"slope": 1.5}).friction
    assert isinstance(steeper, LocalFriction) and isinstance(model.friction, LocalFriction)
    for v, before, after in zip(model.friction.velocities, model.friction.torques, steeper.torques, strict=True):
        fall = 0.025 * np.exp(-((v / 0.1) ** 2))
        assert after - before == pytest.approx(np.sign(v) * 0.5 * fall, abs=1e-9)


def test_without_a_fitted_curve_the_fall_is_what_stands_above_the_least() -> None:
    model = identified(0.01, 1e-4).model_copy(update={"identified": None})
    flatter = steady_friction(scaled(model, {"slope": 0.0}))
    assert isinstance(model.friction, LocalFriction)
    dry = [flatter.dry(v) for v in model.friction.velocities if v > 0.0]
    assert min(np.diff(dry)) > -1e-9  # it falls no more


def test_identified_noise_is_one_for_all_and_rounding_is_not_counted_twice() -> None:
    noise = noise_of(noisy())
    assert noise is not None
    assert (noise.torque_rms, noise.torque_bandwidth_hz, noise.encoder_rms) == (1e-3, IDENTIFIED_HZ, 3e-6)
    count = 2.0 * np.pi / 2**20
    beside = noise_of(noisy(), count)
    assert beside is not None and beside.encoder_rms == pytest.approx((9e-12 - count**2 / 12.0) ** 0.5)
    assert quiet(noisy(), count).noise == beside.model_copy(update={"torque_rms": 0.0})
    assert noise_of(table1()) == table1().noise


def test_a_hold_under_identified_noise_is_not_still_by_construction() -> None:
    gains = table1_set()
    assert gains.design is not None
    assert hold_ripple(gains, gains.design, noisy()) > 1e-6


def test_motions_follow_the_axis_and_reach_past_its_fall() -> None:
    design = table1_set().design
    assert design is not None
    scale = scale_of(design)
    assert scale.large_rad == pytest.approx(0.1) and 0.07 < scale.peak_rad_s < 0.12
    slow = design.model.friction.model_copy(update={"stribeck_velocity": 0.2})
    later = scale_of(design.model_copy(update={"model": design.model.model_copy(update={"friction": slow})}))
    assert later.peak_rad_s > 1.5 * scale.peak_rad_s
    half = scale_of(design.model_copy(update={"speed_max_rad_s": 0.25}))
    assert half.large_rad == pytest.approx(LARGE_STEP_S * 0.25)
    assert np.ptp(trial_motion(design.period_s, half)[:, 0]) == pytest.approx(2.0 * half.sine_rad, rel=0.01)


def test_a_plant_that_gets_nowhere_fails_by_what_it_misses() -> None:
    gains = table1_set()
    assert gains.design is not None
    motion = trial_motion(gains.design.period_s, scale_of(gains.design))
    assert run_sample(gains, gains.design, motion, 1, 0).stable
    heavy = gains.design.model.model_copy(update={"torque_offset": -1.0})
    lost = run_sample(gains, gains.design.model_copy(update={"model": heavy}), motion, 1, 0)
    assert not lost.follows and not lost.arrives and not lost.stable


def test_the_drive_of_the_trials_has_no_more_torque_than_the_axis() -> None:
    design = table1_set().design
    assert design is not None
    assert scale_of(design).torque_nm == pytest.approx(3.0 * steady_friction(design.model).largest(0.5))
    assert scale_of(design.model_copy(update={"torque_limit_nm": 0.1})).torque_nm == 0.1
