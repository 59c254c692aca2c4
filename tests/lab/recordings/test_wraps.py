"""Positions that wrap are joined where the rows say so beyond doubt; another unit is asked about, never put right."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from servod.lab.recordings import Quantity, Recording, load_recording
from servod.lab.recordings.recording import find_wrap

T = np.arange(2000) * 1e-3
NOISE = np.random.default_rng(1).normal(size=len(T))


def load(folder: Path, position: np.ndarray, reference: np.ndarray | None = None) -> Recording:
    goal = position if reference is None else reference
    np.savez(folder / "r.npz", t_s=T, torque_nm=np.sin(T), position_rad=position, reference_rad=goal)
    return load_recording(folder / "r.npz")


@pytest.mark.parametrize("size", [2 * math.pi, 25.0, 360.0, 65536.0, 7.3])
@pytest.mark.parametrize("motion", ["onward", "to and fro"])
def test_a_wrap_is_joined_and_told(size: float, motion: str, tmp_path: Path) -> None:
    way = 3.2 * T / T[-1] if motion == "onward" else 1.7 * np.sin(5.0 * T)
    real = size * (0.1 + way) + 1e-5 * size * NOISE
    recording = load(tmp_path, (real + size / 2) % size - size / 2, (real + 0.01 * size) % size - size / 2)
    moved = recording.position - real
    assert np.allclose(
        moved, moved[0], atol=(1e-4 if size == 7.3 else 1e-6) * size
    )  # a range without a name is measured
    assert any("joined: the position wraps there" in line for line in recording.report)
    error = recording.columns[Quantity.REFERENCE] - recording.position
    assert np.ptp(error) < 0.05 * size


@pytest.mark.parametrize(
    "position",
    [
        np.sign(np.sin(8.0 * T)) * 12.5,  # a square wave of the range itself
        np.where(T > 1.0, 3.0, 0.2) + 0.1 * np.sin(9.0 * T),  # a zero that was set again
        0.5 * np.sin(8.0 * T) + 1e-4 * NOISE,
        np.where(np.arange(len(T)) == 700, 65535.0, np.sin(T)),  # a glitch
    ],
)
def test_what_is_no_wrap_stays(position: np.ndarray, tmp_path: Path) -> None:
    assert find_wrap(position) is None
    assert np.array_equal(load(tmp_path, position).position, position)


def test_another_unit_is_asked_about_and_not_changed(tmp_path: Path) -> None:
    counts = np.round(32767.5 + 32767.5 * np.sin(5.0 * T))
    recording = load(tmp_path, counts)
    assert np.array_equal(recording.position, counts)
    assert recording.report[0].startswith("position_rad: position spans 65535, in whole numbers: counts?")
    degrees = 90.0 * np.sin(5.0 * T)
    recording = load(tmp_path, degrees)
    assert np.array_equal(recording.position, degrees) and "degrees?" in recording.report[0]
    for fine in (300.0 * T, 20.0 * T + 0.1 * np.sin(600.0 * T), 3.0 * np.sin(5.0 * T)):
        assert load(tmp_path, fine).report == ()
