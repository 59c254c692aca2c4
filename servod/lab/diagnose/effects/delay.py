"""Delay: the torque comes later than the model says."""

from __future__ import annotations

from dataclasses import replace

from servod.formats.model.effects import Delay
from servod.lab.diagnose.effects.base import DELAY_S
from servod.lab.diagnose.effects.effect import Effect, simple
from servod.lab.diagnose.effects.hypothesis import Document, Term, Unknown, get
from servod.lab.diagnose.effects.looks import Look
from servod.lab.diagnose.effects.search_context import SearchContext

#: Delays to start from, s.
STARTS_S = (0.002, 0.004, 0.008, 0.02, 0.045)

#: From where a delay is told as one: an estimate of one at the level may fall short of it.
LATE_S = 0.95 * DELAY_S


def terms(scene: SearchContext) -> list[Term]:
    """Some starts: the cost has a valley for each wave of the excitation. The model's own delay stays: both are one."""
    own = get(scene.document, "delay_s", 0.001)
    found = []
    for start in STARTS_S:
        unknown = Unknown("additional_s", "s", start, -min(own, 0.001), 0.1, 2e-3)
        found.append(replace(simple("delay", "dead time", [unknown]), opens={"delay_s": (own, own)}))
    return found


def _at_level(nominal: Document, fitted: Document) -> bool:
    return abs(get(fitted, "delay.additional_s") + get(fitted, "delay_s") - get(nominal, "delay_s")) >= LATE_S


EFFECT = Effect(
    name="delay",
    group=Delay,
    equation="torque(t) = command(t - delay_s - additional_s)",
    source="bus cycles, filters, scheduling in the drive",
    statement="The torque comes later than the model says: a dead time",
    shows="a mismatch in proportion to the change of the command, whatever the speed",
    confused=("actuator_lag", "joint_elasticity", "inertia"),
    experiment="steps of command, sampled faster than the delay: dead time waits, lag begins at once",
    terms=terms,
    look=Look("change of the command"),
    far=True,
    swift=True,
    soaks_up=True,
    twin="actuator_lag",
    lateness="delay.additional_s",
    at_level=_at_level,
)
