"""The axis that tunings of these tests see: Table I's joint with asymmetry, cogging and noise, known within 5 %."""

from __future__ import annotations

from servod.common.yaml import validate
from servod.formats.model.axis_model import AxisModel
from servod.lab.tune.plan import TuningSettings


def joint(size: float = 1.0, lean: float = 0.28) -> AxisModel:
    """`size` multiplies every torque and the inertia, `lean` is the difference between both directions."""
    return validate(
        {
            "inertia": 0.001 * size,
            "delay_s": 0.001,
            "friction": {
                "kind": "lugre",
                "sigma0": 950.0 * size,
                "sigma1": 1.0 * size,
                "viscous": 0.056 * size,
                "coulomb": 0.045 * size,
                "static": 0.07 * size,
                "stribeck_velocity": 0.1,
            },
            "asymmetry": {"positive_dry": 1.0 + lean / 2.0, "negative_dry": 1.0 - lean / 2.0},
            "cogging": {"harmonics": [{"amplitude": 0.002 * size, "periods_per_turn": 22, "phase": 0.7}]},
            "noise": {"torque_rms": 3e-4 * size, "torque_bandwidth_hz": 200.0, "encoder_rms": 2e-6},
        },
        AxisModel,
        "joint",
    )


def small(budget: int = 60, seed: int = 1, size: float = 1.0) -> TuningSettings:
    """A plan for tests: two plants, and few of them."""
    return TuningSettings(budget=budget, plants=2, seed=seed, torque_limit_nm=0.3 * size)
