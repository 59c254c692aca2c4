"""Joints that guide the feedback beside the vertices, and are no part of the proof: the bristle being turned over.

Stands under the deployed mode. After a reversal a bristle is twice as stiff for milliseconds. The certificate judges
that at every speed; a feedback made for a steep fall of friction alone is too much for it there.
"""

from __future__ import annotations

import itertools

from servod.formats.gains.design import Design, RegionProof
from servod.lab.verify.closed_loop import Bristle, Deviation, joint_point
from servod.lab.verify.proof import scaled
from servod.lab.verify.sampled import Array, timing_of
from servod.lab.verify.steady_friction import steady_friction
from servod.lab.verify.vertices import Joint, ends, known_commands

#: (centre, radius) asked for: stable, no more, for it lasts for milliseconds.
TURNING_DISC = 0.0, 0.999


def turning(design: Design, proof: RegionProof, speed_rad_s: float) -> tuple[list[Joint], Array, Array, Array]:
    """The turned bristle at `speed_rad_s` both ways, where it rings most, with its scaled (A, B, E)."""
    friction, u, found = steady_friction(design.model), design.uncertainty, []
    for side, damping in itertools.product((1.0, -1.0), ends(u.damping)):
        corner = Deviation(1.0 - u.inertia, 1.0 + u.torque_gain, 1.0 + u.stiffness, damping, viscous=1.0 - u.viscous)
        matrices = joint_point(friction, side * speed_rad_s, Bristle.TURNS, corner).matrices()
        found.append(Joint(f"turning {side * speed_rad_s:g} {damping:g}", "turning", False, *matrices))
    return found, *scaled(found, with_shortest_delay(design), proof)


def with_shortest_delay(design: Design) -> Design:
    """`design` with the shortest delay of its interval, if as many commands are on their way then: the loop's states.

    A turned bristle rings faster than the loop's phase crossover, where less delay is less stable.
    """
    model = design.model
    shorter = model.model_copy(update={"delay_s": max(model.delay_s - design.uncertainty.delay_s, 0.0)})
    early = design.model_copy(update={"model": shorter})
    same = known_commands(timing_of(early)) == known_commands(timing_of(design))
    return early if same else design
