"""Metrics of runs against motions whose answers are known."""

from __future__ import annotations

import math

import numpy as np
import pytest

from servod.common.errors import AnswerIsNo
from servod.lab.tracking.metrics import Curves, HoldOf, Tracking, roughness, score, step_response, swings, tracking

PERIOD_S = 1e-3
COUNT_RAD = 2.0 * math.pi / 2**20


def hold(seconds: float = 20.0) -> np.ndarray:
    return np.arange(round(seconds / PERIOD_S)) * PERIOD_S


def second_order(t: np.ndarray, damping: float, omega: float) -> np.ndarray:
    """Unit step of x'' + 2 d w x' + w^2 x = w^2, underdamped."""
    ringing = omega * math.sqrt(1.0 - damping**2)
    decay = np.exp(-damping * omega * t)
    return 1.0 - decay * (np.cos(ringing * t) + damping * omega / ringing * np.sin(ringing * t))


@pytest.mark.parametrize(("damping", "omega"), [(0.2, 40.0), (0.5, 60.0), (0.7, 100.0)])
@pytest.mark.parametrize("step_rad", [0.1, -0.1])
def test_overshoot_and_settling_of_a_second_order_step(damping: float, omega: float, step_rad: float) -> None:
    t = hold(5.0)
    response = step_response(t, step_rad * second_order(t, damping, omega), step_rad, COUNT_RAD)
    assert response.overshoot == pytest.approx(math.exp(-math.pi * damping / math.sqrt(1.0 - damping**2)), rel=2e-3)
    # the envelope exp(-d w t)/sqrt(1-d^2) bounds the error, which is within half a period of reaching it
    latest = -math.log(0.02 * math.sqrt(1.0 - damping**2)) / (damping * omega)
    assert response.settling_s is not None
    assert latest - math.pi / (omega * math.sqrt(1.0 - damping**2)) <= response.settling_s <= latest + PERIOD_S
    assert not response.limit_cycle


def test_a_first_order_step_settles_at_four_time_constants() -> None:
    t = hold()
    response = step_response(t, 0.1 * (1.0 - np.exp(-t / 0.03)), 0.1, COUNT_RAD)
    assert response.settling_s == pytest.approx(0.03 * math.log(50.0), abs=1.5 * PERIOD_S)
    assert response.overshoot == 0.0
    assert response.steady_error_mrad < 1e-6


def test_a_small_step_settles_to_what_the_encoder_can_tell() -> None:
    """Two per cent of the step is less than a count here."""
    t = hold()
    position = np.round(20.0 * second_order(t, 0.7, 60.0)) * COUNT_RAD
    assert step_response(t, position, 20.0 * COUNT_RAD, COUNT_RAD).settling_s == pytest.approx(0.044, abs=0.01)


def test_an_error_that_stays_is_steady_error_and_never_settles() -> None:
    t = hold()
    response = step_response(t, np.where(t < 0.1, 0.0, 0.0093), 0.01, COUNT_RAD)
    assert response.settling_s is None
    assert response.steady_error_mrad == pytest.approx(0.7)
    assert response.hold_mrad == 0.0


@pytest.mark.parametrize("frequency_hz", [0.3, 1.0, 4.0, 12.0, 45.0, 130.0, 300.0])
def test_a_sine_of_several_counts_is_a_limit_cycle(frequency_hz: float) -> None:
    t = hold()
    noise = np.random.default_rng(1).normal(0.0, 2e-6, len(t))
    swing = 2.0 * COUNT_RAD * np.sin(2.0 * math.pi * frequency_hz * t)
    position = np.round((0.01 + swing + noise) / COUNT_RAD) * COUNT_RAD
    response = step_response(t, position, 0.01, COUNT_RAD)
    assert response.limit_cycle
    assert response.hold_mrad == pytest.approx(4.0 * COUNT_RAD * 1e3, abs=3.5 * COUNT_RAD * 1e3)


@pytest.mark.parametrize("seed", range(5))
def test_noise_of_a_count_and_creep_are_no_limit_cycle(seed: int) -> None:
    t = hold()
    creep = 30.0 * COUNT_RAD * np.exp(-t / 8.0)
    noise = np.random.default_rng(seed).normal(0.0, COUNT_RAD, len(t))
    position = np.round((0.01 - creep + noise) / COUNT_RAD) * COUNT_RAD
    assert not step_response(t, position, 0.01, COUNT_RAD).limit_cycle


def test_stick_slip_hunting_of_seconds_is_a_limit_cycle() -> None:
    t = hold()
    position = 0.01 + 5.0 * COUNT_RAD * np.sign(np.sin(2.0 * math.pi * t / 5.0 + 0.1))
    assert step_response(t, position, 0.01, COUNT_RAD).limit_cycle


def test_swings_count_turns_and_not_drift() -> None:
    t = np.linspace(0.0, 10.0, 2001)
    assert swings(0.5 * t, 1.0) == 1
    assert swings(0.5 * t + 2.0 * np.sin(2.0 * math.pi * t), 1.0) == 20 + 1
    assert swings(0.4 * np.sin(2.0 * math.pi * t), 1.0) == 0


def test_the_score_leaves_out_the_first_second_and_signs_do_not_cancel() -> None:
    t = hold(3.0)
    error = np.where(t < 1.0, 50.0, np.where(np.arange(len(t)) % 2 == 0, 3.0, -3.0))
    assert score(t, error).rms_error_mrad == pytest.approx(3.0)
    assert score(t, error).max_error_mrad == pytest.approx(3.0)
    with pytest.raises(AnswerIsNo, match="first 1 s"):
        score(t[:900], error[:900])


def test_roughness_is_the_change_from_cycle_to_cycle() -> None:
    t = hold(3.0)
    assert roughness(t, 0.002 * (np.arange(len(t)) % 2)) == pytest.approx(0.002)
    assert roughness(t, 0.1 * t) == pytest.approx(0.1 * PERIOD_S)


def curves(t: np.ndarray, reference: np.ndarray, position: np.ndarray) -> Curves:
    zero = np.zeros_like(t)
    return Curves(t, reference, position, zero, zero, zero, zero)


def test_a_step_that_is_not_held_has_no_figures() -> None:
    t = hold(0.5)
    with pytest.raises(AnswerIsNo, match="held for less"):
        step_response(t, np.full_like(t, 0.01), 0.01, COUNT_RAD)


def test_the_document_has_steps_by_their_size_in_mrad() -> None:
    t = hold(3.0)
    run = tracking(
        curves(t, 0.1 * np.sin(t), 0.1 * np.sin(t) - 1e-3),
        {size: curves(t, np.full_like(t, size * 1e-3), np.full_like(t, size * 1e-3)) for size in (100.0, 10.0)},
        COUNT_RAD,
    )
    document = run.document()
    assert document["rms_error_mrad"] == pytest.approx(1.0)
    assert list(document["steps"]) == ["100", "10"]
    figures = {"settling_s", "overshoot", "steady_error_mrad", "limit_cycle"}
    assert set(document["steps"]["10"]) == figures | {"hold_mrad", "hold_of", "hold_encoder_mrad", "hold_noise_mrad"}
    assert set(run.curves) == {"paper", "step_100", "step_10"}
    assert isinstance(run, Tracking)


def test_a_hold_is_judged_by_the_joint_where_it_is_known_and_beside_its_encoder_by_what_noise_shows() -> None:
    t, random = hold(), np.random.default_rng(1)
    position = np.round((0.01 + random.normal(0.0, 4e-6, len(t))) / COUNT_RAD) * COUNT_RAD
    told = step_response(t, position, 0.01, COUNT_RAD, true_swing_rad=5e-6, encoder_rms_rad=4e-6)
    alone = step_response(t, position, 0.01, COUNT_RAD, encoder_rms_rad=4e-6)
    assert told.hold_mrad == pytest.approx(0.005)
    assert (told.hold_of, alone.hold_of) == (HoldOf.JOINT, HoldOf.ENCODER)
    assert alone.hold_mrad == alone.hold_encoder_mrad == told.hold_encoder_mrad
    assert alone.hold_encoder_mrad == pytest.approx(alone.hold_noise_mrad, rel=0.25)
    assert not alone.limit_cycle
    moved = step_response(t, position + 3e-5 * np.sin(0.5 * t), 0.01, COUNT_RAD, encoder_rms_rad=4e-6)
    assert moved.hold_encoder_mrad > 1.8 * moved.hold_noise_mrad


@pytest.mark.parametrize("wanders", [0.0, 60.0])
def test_a_fast_cycle_is_no_noise(wanders: float) -> None:
    """40 urad at 300 Hz, with a line, and without where its frequency wanders: known noise does not explain it."""
    t, random = hold(), np.random.default_rng(2)
    phase = np.cumsum(2.0 * math.pi * (300.0 + wanders * random.normal(0.0, 1.0, len(t))) * PERIOD_S)
    reading = 0.01 + 2e-5 * np.sin(phase) + random.normal(0.0, 2e-6, len(t))
    position = np.round(reading / COUNT_RAD) * COUNT_RAD
    found = step_response(t, position, 0.01, COUNT_RAD, encoder_rms_rad=2e-6)
    assert found.limit_cycle and found.hold_encoder_mrad > 1.5 * found.hold_noise_mrad
    unknown = step_response(t, position, 0.01, COUNT_RAD)
    assert unknown.hold_noise_mrad < found.hold_noise_mrad  # rounding alone explains less


def test_a_joint_between_two_counts_is_no_limit_cycle() -> None:
    t, random = hold(), np.random.default_rng(3)
    position = np.round(0.5 + random.normal(0.0, 0.05, len(t))) * COUNT_RAD
    assert not step_response(t, position, 0.5 * COUNT_RAD, COUNT_RAD, encoder_rms_rad=0.0).limit_cycle
