"""What has changed on an axis between two identifications: the repeat that a worn, cold or newly loaded joint asks for.

Beside the result; reads only what stands in two axis model files.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from servod.formats.model.identified import Identified, IdentifiedMap, IdentifiedValue

Array = NDArray[np.float64]

#: A difference counts beyond this multiple of both half widths together: among some thirty numbers, one that lies just
#: outside both intervals is no news.
BEYOND = 1.25
#: Numbers that say where the joint stood or how noisy the moment was, not what the joint is.
OF_THE_MOMENT = ("break_away_positive", "break_away_negative", "torque_noise_rms", "torque_reading_noise_rms")
SLOWEST_RAD_S = 0.005
_NODES = 40


def changes(before: Identified, now: Identified) -> list[str]:
    """One sentence for each number, and for each direction of the friction map, that changed; empty when none did."""
    told = [
        text
        for name, new in now.values.items()
        if name in before.values and name not in OF_THE_MOMENT
        if (text := _of_value(name, before.values[name], new))
    ]
    for direction, sign in (("positive", 1.0), ("negative", -1.0)):
        told += _of_map(direction, *(_side(found.friction_map, sign) for found in (before, now)))
    return told


def _of_value(name: str, old: IdentifiedValue, new: IdentifiedValue) -> str:
    """The sentence, empty when the difference is within both intervals."""
    allowed = BEYOND * 0.5 * (old.high - old.low + new.high - new.low)
    if abs(new.value - old.value) <= allowed:
        return ""
    return f"{name} went from {old.value:.4g} to {new.value:.4g} {new.unit}, outside both 95 % intervals"


def _of_map(direction: str, old: tuple[Array, Array, Array], new: tuple[Array, Array, Array]) -> list[str]:
    """Mean change of friction over the speeds that both maps have."""
    speed = np.geomspace(max(SLOWEST_RAD_S, old[0][0], new[0][0]), min(old[0][-1], new[0][-1]), _NODES)
    friction, half = ([np.interp(speed, side[0], side[i]) for side in (old, new)] for i in (1, 2))
    change = 100.0 * float(np.mean(friction[1] / friction[0] - 1.0))
    unsure = 100.0 * float(np.mean(np.hypot(half[0], half[1]) / friction[0]))
    if abs(change) <= BEYOND * unsure:
        return []
    verb = "rose" if change > 0.0 else "fell"
    return [
        f"friction in {direction} direction {verb} by {abs(change):.1f} % over the map (95 % interval "
        f"{abs(change) - unsure:.1f} to {abs(change) + unsure:.1f} %)"
    ]


def _side(found: IdentifiedMap, sign: float) -> tuple[Array, Array, Array]:
    """Speed, friction magnitude and half width of one direction, ascending."""
    velocity, torque, half = (np.array(column) for column in (found.velocities, found.torques, found.half_widths))
    here = velocity * sign > 0.0
    order = np.argsort(np.abs(velocity[here]))
    return np.abs(velocity[here])[order], np.abs(torque[here])[order], half[here][order]
