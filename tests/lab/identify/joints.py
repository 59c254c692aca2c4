"""Joints drawn at random as acceptance may draw them, and the truth that only scoring reads."""

from __future__ import annotations

import random
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from servod.common.yaml import validate
from servod.formats.model.axis_model import AxisModel
from servod.kernels.physics.friction import directed_curve


class Drawn(NamedTuple):
    """A joint, and the encoder on it."""

    model: AxisModel
    encoder_counts: int


def draw(seed: int, size: float = 1.0, bits: int | None = None) -> Drawn:
    """Table I's joint with everything changed within its range; `size` multiplies every torque and the inertia."""
    r = random.Random(seed)
    lean = r.uniform(0.2, 0.35) * r.choice((-1.0, 1.0))
    model = validate(
        {
            "inertia": 0.001 * r.uniform(0.9, 1.1) * size,
            "delay_s": r.choice((0.001, 0.002)),
            "friction": {
                "kind": "lugre",
                "sigma0": 950.0 * r.uniform(0.85, 1.15) * size,
                "sigma1": r.uniform(0.7, 1.3) * size,
                "viscous": 0.056 * size,
                "coulomb": 0.045 * size,
                "static": 0.07 * size,
                "stribeck_velocity": r.uniform(0.06, 0.14),
            },
            "stribeck": {"exponent": r.uniform(1.0, 2.2)},
            "asymmetry": {
                "positive_dry": 1.0 + lean / 2.0,
                "negative_dry": 1.0 - lean / 2.0,
                "positive_viscous": 1.0 + lean / 4.0,
                "negative_viscous": 1.0 - lean / 4.0,
            },
            "cogging": {
                "harmonics": [
                    {
                        "amplitude": r.uniform(0.5e-3, 4e-3) * size,
                        "periods_per_turn": r.choice((7, 12, 18, 22, 24, 36)),
                        "phase": r.uniform(0.0, 6.0),
                    }
                ]
            },
            "noise": {"torque_rms": 3e-4 * size, "torque_bandwidth_hz": 200.0, "encoder_rms": 2e-6},
        },
        AxisModel,
        f"joint {seed}",
    )
    return Drawn(model, 2 ** (bits or r.choice((17, 20))))


def steady_friction(model: AxisModel, velocity: NDArray[np.float64]) -> NDArray[np.float64]:
    """True friction at steady sliding, with the velocity's sign."""
    p, tables = model.pack()
    viscous = p.viscous * np.where(velocity > 0.0, p.positive_viscous, p.negative_viscous)
    dry = np.array([directed_curve(p, tables, float(v)) for v in velocity])
    return np.sign(velocity) * dry + viscous * velocity
