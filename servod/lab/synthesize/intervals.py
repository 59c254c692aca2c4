"""Half widths of the design's intervals: those that an identification measured, stated defaults for the rest.

Stands between the axis model file and the design. What was measured is taken as wide as it was measured, and never
narrower than a floor: an axis warms, and is not the same tomorrow. Torques are identified in units of the command, so
the torque gain is in every other number and has no interval of its own.
"""

from __future__ import annotations

from servod.formats.gains.design import Uncertainty
from servod.formats.model.axis_model import AxisModel
from servod.lab.verify.measured import FLOORS, measured_widths

#: The design's file takes no wider share. What was measured wider than this stays wider than the design, which then
#: is not certified: `servoctl verify` compares both.
MOST = 0.85


def uncertainty_of(model: AxisModel) -> Uncertainty:
    """The intervals of `model`: identified half widths, but at least the floors; else the defaults."""
    if model.identified is None:
        return Uncertainty()
    bounded = {key: min(max(width, FLOORS[key]), MOST) for key, width in measured_widths(model).items()}
    if "delay_s" in bounded:
        bounded["delay_s"] = min(bounded["delay_s"], model.total_delay_s, 0.01)
    return Uncertainty(torque_gain=0.0, **bounded)
