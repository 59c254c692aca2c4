"""Multisine on a sliding joint: its frequency response.

Reason: inertia, viscous slope, delay and lag, and resonances show in how torque becomes motion over frequency. The
joint slides at constant speed, so that friction is a nearly constant torque and nothing sticks; the multisine comes on
top and never turns the motion round. Amplitude: every line moves the joint at the same share of the sliding speed, and
is scaled down where the torque bound asks for it. Bounds: travel by the strokes' length, speed by both parts together.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servod.lab.identify.experiments.common import Bench
from servod.lab.identify.shapes import multisine, samples, strokes
from servod.lab.identify.trace import ExperimentKind, RecordedMotion

STROKES = 12
PERIOD_S = 1.0
SETTLE_S, TURN_S = 0.25, 0.3
LOWEST_HZ, HIGHEST_HZ, LINES = 3.0, 160.0, 26
#: Sliding speed as a share of the allowed one; peak of the multisine's velocity as a share of the sliding speed.
SPEED_SHARE, PEAK_SHARE = 0.45, 0.6
#: The multisine and what feedback and friction need share the allowed torque.
TORQUE_SHARE = 0.5


class Excitation(NamedTuple):
    """One period of the multisine in N*m, and its lines (periods per excitation period)."""

    wave: np.ndarray[tuple[int], np.dtype[np.float64]]
    lines: np.ndarray[tuple[int], np.dtype[np.int64]]


def design(bench: Bench, inertia: float, speed_rad_s: float) -> Excitation:
    """A multisine whose lines all give the same velocity amplitude on a free inertia."""
    count = samples(PERIOD_S, bench.period_s)
    lines = np.unique(np.round(np.geomspace(LOWEST_HZ * PERIOD_S, HIGHEST_HZ * PERIOD_S, LINES))).astype(np.int64)
    lines = lines[lines < count // 4]
    omega = 2.0 * np.pi * lines / PERIOD_S
    wave = multisine(lines, np.asarray(inertia * omega, dtype=np.float64), count, bench.rng)
    spectrum = np.zeros(count // 2 + 1, dtype=complex)
    spectrum[lines] = np.fft.rfft(wave)[lines] / (1j * omega * inertia)
    peak_rad_s = float(np.max(np.abs(np.fft.irfft(spectrum, count))))
    scale = PEAK_SHARE * speed_rad_s / peak_rad_s
    scale = min(scale, TORQUE_SHARE * bench.bounds.torque_nm / float(np.max(np.abs(wave))))
    return Excitation(scale * wave, lines)


def run(bench: Bench, inertia: float, gains: tuple[float, float]) -> RecordedMotion:
    """Strokes there and back with the multisine on each; `inertia` is the first idea of it."""
    steady_s = SETTLE_S + PERIOD_S
    stroke_s = steady_s + 0.64 * TURN_S
    speed = min(SPEED_SHARE * bench.bounds.speed_rad_s, 1.6 * bench.bounds.travel_rad / stroke_s)
    path, starts = strokes(speed, steady_s, TURN_S, STROKES, bench.period_s)
    excitation = design(bench, inertia, speed)
    torque = np.zeros(len(path))
    count, settle = len(excitation.wave), samples(SETTLE_S, bench.period_s)
    for start in starts:
        torque[start : start + settle] = excitation.wave[-settle:]
        torque[start + settle : start + settle + count] = excitation.wave
    start_rad = -0.5 * float(path.max())
    bench.go_to(bench.bounds.centre_rad + start_rad, gains, 0.5 * speed)
    bench.set_gains(*gains)
    settings = {"first": float(starts[0] + settle), "stride": float(starts[1] - starts[0]), "count": float(count)}
    settings |= {"strokes": float(STROKES), "speed_rad_s": speed, "kp": gains[0], "kd": gains[1]}
    settings |= {f"line_{i}": float(line) for i, line in enumerate(excitation.lines)}
    return bench.run(ExperimentKind.RESPONSE, path, torque, bench.bounds.window_rad, settings)
