"""Recordings of axes that conceal something, made with the 50 us simulator in a closed loop with noise."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servod.formats.model.axis_model import AxisKind, AxisModel
from servod.kernels.laws import LAWS
from servod.lab.recordings import Quantity, Recording
from servod.lab.simulate.simulate import LoopSettings, simulate_closed_loop

Array = NDArray[np.float64]

BELIEVED: dict[str, Any] = {
    "inertia": 0.02,
    "friction": {
        "kind": "lugre",
        "sigma0": 400.0,
        "sigma1": 1.5,
        "viscous": 0.02,
        "coulomb": 0.12,
        "static": 0.15,
        "stribeck_velocity": 0.05,
    },
}

GAINS = (20.0, 0.9, 0.0)


def believed(**more: Any) -> AxisModel:
    return AxisModel.model_validate(BELIEVED | more)


def references(seconds: float) -> list[Array]:
    """A slow sine, a multisine and moves with rests; rows of position, velocity, acceleration."""
    t = np.arange(0.0, seconds, 1e-3)
    grow = np.minimum(t, 1.0)
    slow = 0.9 * np.sin(2.0 * np.pi * 0.4 * t) * grow
    many = sum(0.35 / (1.0 + f) * np.sin(2.0 * np.pi * f * t + 3.0 * f) for f in (0.4, 0.9, 1.7, 3.1, 5.3)) * grow
    steps = np.arange(0.0, seconds + 0.7, 0.7)
    moves = np.interp(t, steps, np.resize([0.0, 0.5, 0.5, -0.4, -0.3, -0.3, 0.6], len(steps)))
    moves = np.convolve(np.pad(moves, 100, mode="edge"), np.hanning(201) / np.hanning(201).sum(), mode="valid")
    return [rows(x) for x in (slow, np.asarray(many), moves)]


def rows(position: Array) -> Array:
    velocity = np.gradient(position, 1e-3)
    return np.column_stack([position, velocity, np.gradient(velocity, 1e-3)])


def record(model: AxisModel, seconds: float = 5.0, seed: int = 1, noise: float = 0.001) -> list[Recording]:
    """Three recordings of an axis; torque noise of `noise` N*m, 20 bit encoder."""
    rng = np.random.default_rng(seed)
    found = []
    for index, reference in enumerate(references(seconds)):
        external = noise * np.convolve(rng.normal(size=len(reference)), np.ones(5) / np.sqrt(5.0), mode="same")
        settings = LoopSettings(counts_per_turn=2.0**20)
        run = simulate_closed_loop(model, LAWS["pd"], GAINS, reference, settings, external_nm=external)
        found.append(recording(run.t_s, run.torque_nm, run.encoder_rad, f"run{index}.csv"))
    return found


def recording(t_s: Array, torque: Array, position: Array, name: str = "run.csv") -> Recording:
    columns = {Quantity.TIME: t_s, Quantity.TORQUE: torque, Quantity.POSITION: position}
    return Recording(Path(name), AxisKind.ROTARY, columns, np.ones(len(t_s), dtype=bool), ())


def write_csv(made: Recording, path: Path) -> None:
    table = np.column_stack([made.t_s, made.torque, made.position])
    np.savetxt(path, table, fmt="%.9g", delimiter=",", header="t_s,torque_nm,position_rad", comments="")
