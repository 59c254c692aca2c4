"""Figure of an identification's frequency response: what the multisine showed, and the model that was put to it.

Stands on the response fit alone.
"""

from __future__ import annotations

import numpy as np

from servod.lab.identify.fits.response import LEAST_COHERENCE, ResponseFit, falling_phase_rad
from servod.lab.report.figure import Array, Axis, Colour, Curve, Figure, Panel, Scale, Style, curve

_POINTS = 300
#: Half width of a 95 % interval over the standard deviation.
_HALF = 1.96


def frequency_response(found: ResponseFit, name: str = "frequency_response") -> Figure:
    """Position over torque command of the sliding joint, measured line by line and fitted, and the coherence."""
    fine = np.geomspace(found.frequency_hz[0], found.frequency_hz[-1], _POINTS)
    gain, error, fitted = np.abs(found.response), _HALF * found.deviation, found.model(fine)
    phase, model_phase = np.degrees(found.phase_rad(found.response)), np.degrees(falling_phase_rad(fitted))
    hz = Axis("frequency in Hz", Scale.LOG)
    panels = (
        Panel(
            hz,
            Axis("position/torque in rad/(N·m)", Scale.LOG),
            _panel(found, gain, (gain * (1.0 - np.minimum(error, 0.99)), gain * (1.0 + error)), fine, np.abs(fitted)),
            "gain",
        ),
        Panel(
            hz,
            Axis("phase in degrees"),
            _panel(found, phase, (phase - np.degrees(error), phase + np.degrees(error)), fine, model_phase),
            "phase",
        ),
        Panel(hz, Axis("coherence in %", span=(0.0, 105.0)), _coherence(found), "coherence"),
    )
    caption = (
        "Torque command to position while the joint slides; bars are 95 % intervals by the scatter of the strokes. "
        f"Lines with less coherence than {LEAST_COHERENCE:.0%} count for nothing."
    )
    return Figure(name, "Frequency response", panels, 3, caption)


def _panel(
    found: ResponseFit, values: Array, bounds: tuple[Array, Array], fine: Array, fitted: Array
) -> tuple[Curve, ...]:
    """The measured lines with their intervals, and the model."""
    measured = curve("measured", found.frequency_hz, values, Colour.BLUE, Style.POINTS, bounds=bounds)
    what = "two masses and a spring" if found.resonance is not None else "rigid joint"
    return measured, curve(f"fitted, {what}", fine, fitted, Colour.ORANGE)


def _coherence(found: ResponseFit) -> tuple[Curve, ...]:
    ends, least = found.frequency_hz[[0, -1]], np.full(2, 100.0 * LEAST_COHERENCE)
    line = curve("least that counts", ends, least, Colour.GREY, Style.DASHED, width=1.0)
    return curve("measured", found.frequency_hz, 100.0 * found.coherence, Colour.BLUE, Style.POINTS), line
