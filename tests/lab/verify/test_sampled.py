"""The sampled system is the continuous one: checked against fine integration, with delays of parts of a cycle."""

from __future__ import annotations

import numpy as np
import pytest

from servod.lab.verify.sampled import Array, SampledTiming, with_delay_and_filter, with_lag

A = np.array([[0.0, 1.0, 0.0], [0.0, -60.0, -9.5e5], [0.0, 0.8, -300.0]])
B, E = np.array([0.0, 1000.0, 0.0]), np.array([0.0, 1000.0, 0.0])
FINE = 2000


def fine(torques: Array, timing: SampledTiming) -> tuple[Array, Array]:
    """Positions and filtered velocities at the samples, by many small exact steps of the plant alone."""
    step = timing.period_s / FINE
    x, seen, filtered = np.zeros(3), 0.0, 0.0
    shift = round(timing.delay_s / step)
    positions, velocities = [], []
    inverse = np.linalg.inv(np.eye(3) - 0.5 * step * A)
    forward = inverse @ (np.eye(3) + 0.5 * step * A)
    push, torque = inverse @ B * step, 0.0
    for k in range(len(torques)):
        positions.append(x[0])
        filtered = timing.kept * filtered + (1.0 - timing.kept) * (x[0] - seen) / timing.period_s if k else 0.0
        velocities.append(filtered)
        seen = x[0]
        for i in range(FINE):
            command = (k * FINE + i - shift) // FINE
            asked = torques[command] if command >= 0 else 0.0
            follows = -np.expm1(-step / timing.lag_s) if timing.lag_s else 1.0
            before, torque = torque, torque + follows * (asked - torque)
            x = forward @ x + push * (0.5 * (before + torque) if timing.lag_s else torque)
    return np.array(positions), np.array(velocities)


@pytest.mark.parametrize("lag_s", [0.0, 0.0011])
@pytest.mark.parametrize("delay_s", [0.0, 0.0004, 0.001, 0.0017, 0.002])
def test_delay_filter_and_lag_are_exact(delay_s: float, lag_s: float) -> None:
    timing = SampledTiming(0.001, delay_s, 150.0, lag_s)
    a, b, _ = with_delay_and_filter(*with_lag(A, B, E, lag_s), timing)
    torques = np.random.default_rng(1).normal(size=12)
    x = np.zeros(len(b))
    sampled = []
    for torque in torques:
        sampled.append(x[[0, 4 if lag_s else 3]].copy())
        x = a @ x + b * torque
    positions, velocities = fine(torques, timing)
    assert np.array(sampled)[:, 0] == pytest.approx(positions, rel=1e-4, abs=1e-9)
    assert np.array(sampled)[:, 1] == pytest.approx(velocities, rel=1e-4, abs=1e-6)
