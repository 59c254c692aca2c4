"""Half widths of the design's intervals: those that an identification measured, stated defaults for the rest.

Stands between the axis model file and the design. A measured interval is taken as it is; one that the identification
could not give, or that is wider than a design can hold, is no reason to guess a narrower one.
"""

from __future__ import annotations

from servod.axis_model import AxisModel
from servod.gain_design import Uncertainty

#: Names of identified values, by the key of Uncertainty that they bound.
MEASURED = {
    "inertia": "inertia",
    "stiffness": "sigma0",
    "damping": "sigma1",
    "viscous": "viscous",
}
LEAST, MOST = 0.01, 0.5


def uncertainty_of(model: AxisModel) -> Uncertainty:
    """The intervals of `model`: identified half widths as shares of the value, within 1 and 50 %, else defaults."""
    known = model.identified.values if model.identified else {}
    found = {}
    for key, name in MEASURED.items():
        value = known.get(name)
        if value is not None and value.value > 0.0:
            found[key] = min(max(0.5 * (value.high - value.low) / value.value, LEAST), MOST)
    return Uncertainty(**found)
