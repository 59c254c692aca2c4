"""Half widths of the design's intervals: those that an identification measured, stated defaults for the rest.

Stands between the axis model file and the design. What was measured is taken as wide as it was measured, and never
narrower than a floor: an axis warms, and is not the same tomorrow. Torques are identified in units of the command, so
the torque gain is in every other number and has no interval of its own.
"""

from __future__ import annotations

import math

from servod.axis_model import AxisModel
from servod.gain_design import Uncertainty
from servod.identified import Identified, IdentifiedValue

#: Names of identified values, by the key of Uncertainty that they bound; of several the widest counts.
MEASURED = {
    "inertia": ("inertia",),
    "stiffness": ("sigma0",),
    "damping": ("sigma1",),
    "viscous": ("viscous_positive", "viscous_negative"),
}
#: Least half widths: what a day's warming may change, and what a fit of four digits would be too proud of.
FLOORS = {"inertia": 0.02, "stiffness": 0.05, "damping": 0.25, "viscous": 0.1, "dry": 0.03, "slope": 0.1}
#: Bristle damping that was not measured but assumed at half of the critical one.
ASSUMED_DAMPING = 0.4
MOST = 0.5
FALL_ENDS = 2.0  # Stribeck velocities: beyond, the map is wider in N*m and says nothing about the fall


def uncertainty_of(model: AxisModel) -> Uncertainty:
    """The intervals of `model`: identified half widths as shares of the value, within floor and 50 %, else defaults."""
    known = model.identified
    if known is None:
        return Uncertainty()
    found = {key: _widest(known.values, names) for key, names in MEASURED.items()}
    if "sigma1" in known.not_identifiable:
        found["damping"] = ASSUMED_DAMPING
    found |= _of_map(known)
    bounded = {key: min(max(share, FLOORS[key]), MOST) for key, share in found.items() if share is not None}
    return Uncertainty(torque_gain=0.0, **bounded)


def _widest(values: dict[str, IdentifiedValue], names: tuple[str, ...]) -> float | None:
    shares = [_half_share(values[name]) for name in names if name in values and values[name].value > 0.0]
    return max(shares, default=None)


def _half_share(value: IdentifiedValue) -> float:
    return 0.5 * (value.high - value.low) / value.value


def _of_map(known: Identified) -> dict[str, float]:
    """Level: the map's mean half width. Slope: two nodes that err apart, over the fall from F_S to F_C."""
    found = known.friction_map
    shares = [abs(h / t) for h, t in zip(found.half_widths, found.torques, strict=True)]
    slopes = [_slope_share(known, side, sign) for side, sign in (("positive", 1.0), ("negative", -1.0))]
    known_slopes = [slope for slope in slopes if slope is not None]
    return {"dry": sum(shares) / len(shares)} | ({"slope": max(known_slopes)} if known_slopes else {})


def _slope_share(known: Identified, side: str, sign: float) -> float | None:
    """Half width of the fall in one direction; None where no fall was found."""
    names = [f"{name}_{side}" for name in ("static", "coulomb", "stribeck_velocity")]
    if not all(name in known.values for name in names):
        return None
    static, coulomb, speed = (known.values[name].value for name in names)
    nodes = zip(known.friction_map.velocities, known.friction_map.half_widths, strict=True)
    widths = [half for v, half in nodes if 0.0 < sign * v <= FALL_ENDS * speed]
    return math.sqrt(2.0) * max(widths) / (static - coulomb) if widths and static > coulomb else None
