"""What `joint_elasticity` and `backlash` share: a part of the inertia behind a spring."""

from __future__ import annotations

import math
from collections.abc import Sequence

from servod.lab.diagnose.effects.hypothesis import Document, Reported, Term, Unknown, get
from servod.lab.diagnose.effects.search_context import SearchContext

#: Shares of critical damping that the joint's spring, and the contact behind a gap, start with.
DAMPING, CONTACT_DAMPING = 0.05, 0.4

#: Share of the viscous friction that acts on the load, as it is believed before any data, and how far it may be off.
BEHIND, BEHIND_SPREAD = 0.15, 0.3

#: Step of derivatives behind a gap, where every contact comes a sample earlier or later.
GAP_NUDGE = 0.03


def two_mass_term(
    effect: str, scene: SearchContext, load: float, resonance: float, gap: float = 0.0, bend: float = 0.0
) -> Term:
    """A term with a share of the inertia behind a spring that resonates at `resonance` rad/s, and a gap if any.

    With `bend` the spring stiffens: by that share of its stiffness at the stretch of a high command.
    """
    inertia = scene.inertia
    stiffness = resonance**2 * inertia * load * (1.0 - load)
    nudge = GAP_NUDGE if gap > 0.0 else 1e-3
    damping = 2.0 * (CONTACT_DAMPING if gap > 0.0 else DAMPING) * math.sqrt(stiffness * inertia * load * (1.0 - load))
    per = f"{scene.force}/{scene.length}"
    unknowns = [
        Unknown("load_share", "1", load, 0.03, 0.97, 0.3, nudge=nudge),
        Unknown("stiffness", per, stiffness, stiffness / 300.0, stiffness * 300.0, nudge=nudge),
        Unknown("damping", f"{scene.force}·s/{scene.length}", damping, damping / 300.0, damping * 300.0, nudge=nudge),
        Unknown("behind", "1", BEHIND, 0.0, 0.95, size=BEHIND_SPREAD, spread=1.0, nudge=max(nudge, 0.01)),
    ]
    if bend > 0.0:
        stiffening = bend * stiffness**3 / scene.effort**2
        unit = f"{per}/{scene.length}²"
        unknowns.append(Unknown("cubic", unit, stiffening, stiffening / 1e4, stiffening * 1e4, nudge=nudge))
    if gap > 0.0:
        unknowns.append(Unknown("gap", scene.length, gap, gap / 50.0, gap * 50.0, nudge=nudge))

    def values_of(document: Document, values: Sequence[float]) -> dict[str, float]:
        found = {
            "load_inertia": values[0] * get(document, "inertia"),
            "stiffness": values[1],
            "damping": values[2],
            "load_viscous": values[3] * get(document, "friction.viscous"),
        }
        return found | {unknown.key: value for unknown, value in zip(unknowns[4:], values[4:], strict=True)}

    def write(document: Document, values: Sequence[float]) -> None:
        found = values_of(document, values)
        if effect == "backlash" and "joint_elasticity" in document:
            found = {"gap": found["gap"]}
        elif effect == "joint_elasticity" and "backlash" in document:
            document["backlash"] = {"gap": document["backlash"]["gap"]}
        document[effect] = found

    def report(document: Document, values: Sequence[float]) -> list[Reported]:
        mass = "kg" if scene.linear else "kg·m²"
        units = {"load_inertia": mass, "stiffness": per, "gap": scene.length, "cubic": f"{per}/{scene.length}²"}
        other = f"{scene.force}·s/{scene.length}"
        return [Reported(key, value, units.get(key, other)) for key, value in values_of(document, values).items()]

    return Term(effect, "stiffening" if bend > 0.0 else "two masses", tuple(unknowns), write, report)
