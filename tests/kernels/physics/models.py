"""Axis models and helpers that the physics tests share."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from servod.formats.model.axis_model import AxisModel
from servod.kernels.physics.plant import Plant

LUGRE: dict[str, Any] = {
    "kind": "lugre",
    "sigma0": 950.0,
    "sigma1": 1.0,
    "viscous": 0.056,
    "coulomb": 0.045,
    "static": 0.07,
    "stribeck_velocity": 0.1,
}


def joint(**groups: Any) -> AxisModel:
    """Table I's joint without delay, with groups of keys replaced or added."""
    return AxisModel.model_validate({"inertia": 0.001, "delay_s": 0.0, "friction": LUGRE, **groups})


def smooth(**groups: Any) -> AxisModel:
    """A joint without friction and delay."""
    return joint(friction={"kind": "coulomb_viscous"}, **groups)


def plant(model: AxisModel) -> Plant:
    """The model as a plant in pure Python: what is tested needs no compiler."""
    return Plant(model, compile_kernel=False)


def g(velocity: float) -> float:
    """The Stribeck curve of LUGRE."""
    return 0.045 + 0.025 * math.exp(-((velocity / 0.1) ** 2))


def states(axis: Plant, torque_nm: float, duration_s: float, every_s: float = 1e-3) -> np.ndarray:
    """Rows of motor position, motor velocity, bristle, load position under a held torque."""
    rows = []
    for _ in range(round(duration_s / every_s)):
        axis.advance(torque_nm, every_s)
        s = axis._s
        rows.append((s.position, s.velocity, s.bristle, s.load_position))
    return np.array(rows)


def period_s(signal: np.ndarray, dt: float) -> float:
    """Mean period from the upward zero crossings of a signal, interpolated."""
    up = np.flatnonzero((signal[:-1] < 0.0) & (signal[1:] >= 0.0))
    times = (up + signal[up] / (signal[up] - signal[up + 1])) * dt
    return float(np.mean(np.diff(times)))
