"""Figures of a motion cycle by cycle, beside those that the laboratory makes of the whole series."""

from __future__ import annotations

import math

import numpy as np
import pytest

from servod.kernels.scoring import MotionCycle, MotionFigures, MotionTally, settling_band
from servod.lab.tracking.metrics import score, step_response

PERIOD_S = 1e-3
COUNT_RAD = 2.0 * math.pi / 2**20


def figures(
    reference: np.ndarray, position: np.ndarray, active: int, missed_at: int | None = None, count_rad: float = COUNT_RAD
) -> MotionFigures | None:
    """Two cycles of rest, `active` cycles of motion, and what is left of both series as rest behind them."""
    tally = MotionTally(count_rad)
    tally.add(MotionCycle(9.998, False, 0.0, 0.0, 0.5, 3))
    tally.add(MotionCycle(9.999, False, 0.0, 0.0, 0.5, 3))
    for k, (r, x) in enumerate(zip(reference.tolist(), position.tolist(), strict=True)):
        missed = 3 if missed_at is None or k < missed_at else 5
        tally.add(MotionCycle(10.0 + k * PERIOD_S, k < active, r, x, 0.1 * math.cos(k), missed))
    return tally.figures()


def test_the_error_is_the_laboratorys() -> None:
    t = np.arange(4000) * PERIOD_S
    reference = 0.05 * np.sin(math.pi * (t + PERIOD_S))
    position = reference - 1e-3 * np.exp(-t) * np.cos(40.0 * t)
    found, wanted = figures(reference, position, 4000), score(t, 1e3 * (reference - position))
    assert found is not None
    assert found.rms_error_mrad == pytest.approx(wanted.rms_error_mrad)
    assert found.max_error_mrad == pytest.approx(wanted.max_error_mrad)
    assert (found.judged_from_s, found.cycles, found.missed_cycles) == (1.0, 4000, 0)
    assert found.peak_torque_nm == pytest.approx(0.1)


@pytest.mark.parametrize("step_rad", [0.1, -0.1, 1e-5])
def test_a_step_settles_as_in_the_laboratory(step_rad: float) -> None:
    t = np.arange(2500) * PERIOD_S
    position = step_rad * (1.0 - np.exp(-t / 0.05) * np.cos(60.0 * t))
    found = figures(np.full(2500, step_rad), position, 2500)
    assert found is not None
    assert found.settling_s == pytest.approx(step_response(t, position, step_rad, COUNT_RAD).settling_s)
    assert found.band_mrad == pytest.approx(1e3 * settling_band(step_rad, COUNT_RAD))


def test_a_motion_settles_from_where_its_reference_came_to_rest() -> None:
    reference = np.concatenate([np.linspace(0.001, 0.1, 500), np.full(500, 0.1)])
    position = reference - np.where(np.arange(1000) < 623, 5e-3, 1e-3)
    found = figures(reference, position, 499, missed_at=300)
    assert found is not None
    assert found.settling_s == pytest.approx((623 - 499) * PERIOD_S)
    assert found.band_mrad == pytest.approx(2.0)
    assert (found.cycles, found.missed_cycles, found.judged_from_s) == (500, 2, 0.0)
    assert found.max_error_mrad == pytest.approx(5.0)
    assert found.watched_s == pytest.approx(0.5)


def test_what_stays_outside_the_band_has_not_settled() -> None:
    found = figures(np.full(1000, 0.1), np.full(1000, 0.09), 10)
    assert found is not None and found.settling_s is None


def test_without_a_motion_there_are_no_figures() -> None:
    assert figures(np.zeros(100), np.zeros(100), 0) is None


def test_what_is_not_finite_is_left_out_and_has_not_settled() -> None:
    position = np.full(100, 0.1)
    position[-1] = math.nan
    found = figures(np.full(100, 0.1), position, 50)
    assert found is not None
    assert found.settling_s is None and found.rms_error_mrad == 0.0
