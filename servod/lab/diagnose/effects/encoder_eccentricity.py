"""Encoder eccentricity: the encoder shows a wave over a turn that the joint does not make."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from servod.formats.model.effects import EncoderEccentricity
from servod.lab.diagnose.effects.effect import Effect, sine_term
from servod.lab.diagnose.effects.hypothesis import Term
from servod.lab.diagnose.effects.looks import Look, Split
from servod.lab.diagnose.effects.search_context import Columns, Peak, SearchContext

Array = NDArray[np.float64]


def _columns(scene: SearchContext) -> Columns:
    """What an error a*sin(n*x) of the encoder looks like: the torque that would make the joint move so."""
    rows = scene.thinned
    speed, growth, fading = scene.velocity[rows], scene.acceleration[rows], scene.fading[rows]

    def columns(n: float, sine: Array, cosine: Array) -> tuple[Array, Array]:
        gain = scene.inertia / (1.0 + (n * fading) ** 2)
        bend, slope = (n * speed) ** 2, n * growth
        return gain * (slope * cosine - bend * sine), gain * (-slope * sine - bend * cosine)

    return columns


def terms(scene: SearchContext) -> list[Term]:
    """One and two periods in a turn; a searched order, also with its second harmonic: a disc off its axis and oval."""
    effect, size = "encoder_eccentricity", 1e-3 * scene.reach
    most = 0.1 * scene.reach
    peaks = scene.peaks(_columns(scene), 2)
    found = [
        sine_term(effect, scene, peak, size, scene.length, most=min(most, 0.4 / peak.n), multiples=multiples)
        for peak, multiples in [*((peak, 1) for peak in peaks), (peaks[0], 2)]
    ]
    low = [] if scene.linear else scene.low_orders(1.0, 2.0)
    fixed = [sine_term(effect, scene, Peak(n, 0.0, 0.0, 0.0), size, scene.length, most=most, free=False) for n in low]
    return fixed + found


EFFECT = Effect(
    name="encoder_eccentricity",
    group=EncoderEccentricity,
    equation="encoder = x + sum amplitude*sin(n*x + phase)",
    source="a disc off its axis (n = 1) or oval (n = 2); interpolation errors of the encoder (high n)",
    statement="The encoder shows a wave over position that the joint does not make",
    shows="a mismatch periodic in position that grows with the square of the speed",
    confused=("position_dependent_inertia", "cogging", "torque_ripple"),
    experiment="the same way at several speeds: the wave of torque grows with the speed squared",
    terms=terms,
    look=Look("position", Split.DIRECTION, periodic=True),
    swift=True,
    repeatable=True,
    soaks_up=True,
)
