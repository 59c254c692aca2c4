"""Spectra of a multisine recording, stroke by stroke: response, coherence and scatter at the excited lines.

Under the response fit, which puts a model to them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from servod.common.errors import AnswerIsNo
from servod.lab.identify.trace import Trace

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]


class Stroke(NamedTuple):
    """Spectra of one stroke at the excited lines: velocity, torque, excitation."""

    velocity: Complex
    torque: Complex
    excitation: Complex


def spectra(trace: Trace) -> tuple[Array, list[Stroke]]:
    """Lines in Hz and the spectra of every whole stroke."""
    s = trace.settings
    count, first, stride = int(s["count"]), int(s["first"]), int(s["stride"])
    lines = np.array([int(s[f"line_{i}"]) for i in range(sum(key.startswith("line_") for key in s))])
    strokes = []
    for i in range(int(s["strokes"])):
        start = first + i * stride
        if start + count >= len(trace):
            break
        way = np.diff(trace.position_rad[start : start + count + 1])
        parts = (way - way.mean(), trace.torque_nm[start : start + count], trace.excitation_nm[start : start + count])
        strokes.append(Stroke(*(np.fft.rfft(part)[lines] / count for part in parts)))
    if len(strokes) < 4:
        raise AnswerIsNo(
            f"the multisine recording has {len(strokes)} whole strokes, and four are needed: see that nothing stops "
            "the axis on its way, or give it more --travel"
        )
    return lines / (count * trace.period_s), strokes


def ratio_of(strokes: Sequence[Stroke]) -> Complex:
    """Way per period over torque, through the excitation as instrument."""
    way = sum(s.velocity * s.excitation.conj() for s in strokes)
    torque = sum(s.torque * s.excitation.conj() for s in strokes)
    ratio: Complex = np.asarray(way / torque)
    return ratio


def coherence_of(strokes: Sequence[Stroke]) -> Array:
    """Share of the motion at each line that follows the excitation."""
    cross = np.abs(sum(s.velocity * s.excitation.conj() for s in strokes)) ** 2
    powers = sum(np.abs(s.velocity) ** 2 for s in strokes) * sum(np.abs(s.excitation) ** 2 for s in strokes)
    coherence: Array = np.asarray(cross / powers)
    return coherence


def deviation_of(strokes: Sequence[Stroke]) -> Array:
    """Relative standard deviation of the strokes' common ratio at each line, smoothed over neighbours."""
    ratio = ratio_of(strokes)
    misfit = np.array([np.abs(s.velocity - ratio * s.torque) ** 2 for s in strokes]).sum(axis=0)
    power = sum(np.abs(ratio * s.torque) ** 2 for s in strokes)
    relative = misfit / (len(strokes) - 1) / np.asarray(power)
    padded = np.pad(relative, 1, mode="edge")
    smooth = (padded[:-2] + padded[1:-1] + padded[2:]) / 3.0
    deviation: Array = np.sqrt(smooth + 1e-6)
    return deviation


def position_over_torque(frequency: Array, ratio: Complex, period_s: float) -> Complex:
    """From way per period to position at the sample."""
    z = np.exp(2j * np.pi * frequency * period_s)
    position: Complex = ratio / (z - 1.0)
    return position
