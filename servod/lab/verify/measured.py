"""Half widths of what an identification measured, as shares of the values: what a design's intervals must hold.

Stands on the identified values alone; synthesis widens them to its floors, verification compares them with the design.
An interval need not be even: the wider side counts, as wide as it was measured.
"""

from __future__ import annotations

import math

from servod.formats.gains.design import Uncertainty
from servod.formats.model.axis_model import AxisModel
from servod.formats.model.identified import Identified, IdentifiedValue

#: Names of identified values, by the key of Uncertainty that they bound; of several the widest counts.
MEASURED = {
    "inertia": ("inertia",),
    "stiffness": ("sigma0",),
    "damping": ("sigma1",),
    "viscous": ("viscous_positive", "viscous_negative"),
}
#: Bristle damping that could not be measured is assumed at half of the critical one. Bearings and gears are found
#: between a quarter and three quarters of it; below, the bristle would ring for long enough to be measured after all.
ASSUMED_DAMPING = 0.5
#: Least half widths: what a day's warming may change, and what a fit of four digits would be too proud of; the delay's
#: is what a cycle jitters [s].
FLOORS = {
    "inertia": 0.02,
    "stiffness": 0.05,
    "damping": 0.25,
    "viscous": 0.1,
    "dry": 0.03,
    "slope": 0.1,
    "delay_s": 20e-6,
}
FALL_ENDS = 2.0  # Stribeck velocities: beyond, the map is wider in N*m and says nothing about the fall


def measured_widths(model: AxisModel) -> dict[str, float]:
    """Half widths by key of Uncertainty, `delay_s` in s; empty for a model that was not identified."""
    known = model.identified
    if known is None:
        return {}
    shares = {key: _widest(known.values, names) for key, names in MEASURED.items()}
    found = {key: share for key, share in shares.items() if share is not None}
    if "sigma1" in known.not_identifiable:
        found["damping"] = ASSUMED_DAMPING
    if "delay_s" in known.values:
        found["delay_s"] = _half_width(known.values["delay_s"])
    return found | _of_map(known)


def least_widths(model: AxisModel) -> dict[str, float]:
    """Half widths below which a design's intervals may not be: the floors, and a stated default where that is less."""
    measured, default = measured_widths(model), Uncertainty().model_dump()
    least = {key: floor if key in measured else min(floor, default[key]) for key, floor in FLOORS.items()}
    return least | {"delay_s": min(least["delay_s"], model.total_delay_s)}


def _widest(values: dict[str, IdentifiedValue], names: tuple[str, ...]) -> float | None:
    shares = [_half_width(values[n]) / values[n].value for n in names if n in values and values[n].value > 0.0]
    return max(shares, default=None)


def _half_width(value: IdentifiedValue) -> float:
    return max(value.high - value.value, value.value - value.low)


def _of_map(known: Identified) -> dict[str, float]:
    """Level: the widest node by its torque. Slope: two nodes that err apart, over the fall from F_S to F_C."""
    found = known.friction_map
    level = max(abs(half / torque) for half, torque in zip(found.half_widths, found.torques, strict=True))
    slopes = [_slope_share(known, side, sign) for side, sign in (("positive", 1.0), ("negative", -1.0))]
    known_slopes = [slope for slope in slopes if slope is not None]
    return {"dry": level} | ({"slope": max(known_slopes)} if known_slopes else {})


def _slope_share(known: Identified, side: str, sign: float) -> float | None:
    """Half width of the fall in one direction; None where no fall was found."""
    names = [f"{name}_{side}" for name in ("static", "coulomb", "stribeck_velocity")]
    if not all(name in known.values for name in names):
        return None
    static, coulomb, speed = (known.values[name].value for name in names)
    nodes = zip(known.friction_map.velocities, known.friction_map.half_widths, strict=True)
    widths = [half for v, half in nodes if 0.0 < sign * v <= FALL_ENDS * speed]
    return math.sqrt(2.0) * max(widths) / (static - coulomb) if widths and static > coulomb else None
