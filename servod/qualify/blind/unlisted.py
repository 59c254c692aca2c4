"""Draws physics that is on nobody's list: the right answer is that something unexplained is there, and where.

Beside the drawings of `hidden_friction`, `hidden_place` and `hidden_drive`.
"""

from __future__ import annotations

from servod.qualify.blind.concealed import Concealed, Draw


def cage_resonance(draw: Draw) -> Concealed:
    """Friction that peaks in a band of speeds."""
    speed = draw.between(0.25, 0.5) * draw.axis.speed
    torque = draw.size(0.5, 1.0) * draw.physics.coulomb * 1.2
    return Concealed({"peak_torque": torque, "peak_speed": speed, "peak_width": 0.18 * speed})


def ageing_contacts(draw: Draw) -> Concealed:
    """Friction that grows with the time at rest and is forgotten in motion, which takes time too."""
    return Concealed({"ageing": draw.size(0.6, 1.2), "ageing_s": draw.between(0.15, 0.4)})


def relaxing_spring(draw: Draw) -> Concealed:
    """A belt that creeps: a spring whose rest position follows within a second."""
    stiffness = draw.size(0.8, 1.6) * draw.physics.coulomb / draw.axis.motions.travel
    return Concealed({"relaxing": stiffness, "relaxing_s": draw.between(0.3, 1.0)})


def chaotic_load(draw: Draw) -> Concealed:
    """A load that swings by itself and never repeats."""
    return Concealed({"chaos": draw.size(0.3, 0.7) * draw.physics.coulomb, "chaos_rate": draw.between(0.6, 1.5)})


def travelled_way(draw: Draw) -> Concealed:
    """Friction with a period in the way travelled: balls that recirculate."""
    return Concealed({"way_share": min(draw.size(0.3, 0.5), 0.9), "way_length": draw.between(0.45, 0.9)})


def patchy_friction(draw: Draw) -> Concealed:
    """Friction that jumps between two levels at times of its own."""
    return Concealed({"patchy_share": draw.size(0.25, 0.5), "patchy_s": draw.between(0.3, 0.8)})
