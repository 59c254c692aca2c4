"""The demo's laws through the loop's own controller, sampled as a wall clock does: late, early, or not at all."""

from __future__ import annotations

import math
import random
from pathlib import Path

import pytest

from servod.formats.gains.gain_set import load_gains
from servod.formats.model.axis_model import load_axis_model
from servod.kernels.motions import paper
from servod.kernels.physics.plant import Plant
from servod.runtime.loop.controller import Controller

GAINS = Path(__file__).resolve().parents[3] / "gains"
PERIOD_S, JITTER_S, COUNT_RAD, CUTOFF_HZ = 0.001, 1e-4, 2.0 * math.pi / 2**20, 120.0
MISSED_SHARE, MOST_MISSED = 0.003, 5


def rms_mrad(gain_set: str, seed: int, seconds: float) -> float:
    """RMS error without the first second, sampled with jitter and missed periods."""
    gains, chance = load_gains(GAINS / f"{gain_set}.yaml"), random.Random(seed)
    plant = Plant(load_axis_model(GAINS / "axes" / "demo_joint.yaml"), seed=seed)
    controller = Controller()
    assert controller.activate(gains.law.number, gains.pack(), 0.0)
    now, last, seen, velocity, torque, due, squares, n = 0.0, -PERIOD_S, 0.0, 0.0, 0.0, 0, 0.0, 0
    while now < seconds:
        measured = round(plant.encoder_position_rad / COUNT_RAD) * COUNT_RAD
        dt = now - last
        velocity += ((measured - seen) / dt - velocity) * -math.expm1(-2.0 * math.pi * CUTOFF_HZ * dt)
        x_ref, v_ref, a_ref = paper(now)
        torque = round(controller.step(x_ref, v_ref, a_ref, measured, velocity, torque, dt).u, 4)
        if now > 1.0:
            squares, n = squares + (x_ref - plant.position_rad) ** 2, n + 1
        seen, last = measured, now
        due += 1 + (chance.randint(1, MOST_MISSED) if chance.random() < MISSED_SHARE else 0)
        now = due * PERIOD_S + chance.uniform(-JITTER_S, JITTER_S)
        plant.advance(torque, now - last)
    return math.sqrt(squares / n) * 1e3


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize(("gain_set", "bound_mrad"), [("demo_local", 0.1), ("demo_local_stiff", 0.06)])
def test_tracks_through_jitter_and_missed_periods(gain_set: str, bound_mrad: float, seed: int) -> None:
    assert rms_mrad(gain_set, seed, seconds=6.0) < bound_mrad
