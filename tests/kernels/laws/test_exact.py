"""The exact step of the friction state against a high-resolution solution, and its limits."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servod.kernels.laws.observers import decayed, limited


def fine_solution(z: float, decay: float, drive: float, dt: float) -> float:
    """Classic Runge-Kutta with steps far below the time constant."""
    n = 400 + int(100 * decay * dt)
    h = dt / n
    for _ in range(n):
        k1 = drive - decay * z
        k2 = drive - decay * (z + h / 2 * k1)
        k3 = drive - decay * (z + h / 2 * k2)
        k4 = drive - decay * (z + h * k3)
        z += h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return z


@pytest.mark.parametrize("decay", [0.0, 1e-7, 1.0, 50.0, 800.0, 10_000.0])
@pytest.mark.parametrize("drive", [-0.5, 0.0, 0.06])
@pytest.mark.parametrize("dt", [0.0005, 0.001, 0.005])
def test_step_agrees_with_a_high_resolution_solution(decay: float, drive: float, dt: float) -> None:
    assert decayed(4e-5, decay, drive, dt) == pytest.approx(fine_solution(4e-5, decay, drive, dt), rel=1e-6, abs=1e-14)


@given(decay=st.floats(0.0, 1e6), drive=st.floats(-1.0, 1.0), dt=st.floats(1e-4, 0.1))
def test_two_half_steps_are_one_step(decay: float, drive: float, dt: float) -> None:
    half = decayed(decayed(3e-5, decay, drive, dt / 2), decay, drive, dt / 2)
    assert half == pytest.approx(decayed(3e-5, decay, drive, dt), rel=1e-6, abs=1e-13)


def test_explicit_euler_would_diverge_where_the_exact_step_settles() -> None:
    z = 1e-4
    for _ in range(100):
        z = decayed(z, 9000.0, 0.5, 0.001)
    assert z == pytest.approx(0.5 / 9000.0)


@pytest.mark.parametrize(("value", "expected"), [(2.0, 1.0), (-2.0, -1.0), (0.5, 0.5), (math.inf, 1.0)])
def test_limited(value: float, expected: float) -> None:
    assert limited(value, 1.0) == expected


def test_limiting_does_not_hide_nan() -> None:
    assert math.isnan(limited(math.nan, 1.0))
    assert math.isnan(decayed(math.nan, 1.0, 0.0, 0.001))
    assert math.isnan(decayed(0.0, math.nan, 0.0, 0.001))
