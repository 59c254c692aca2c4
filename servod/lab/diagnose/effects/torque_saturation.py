"""Torque saturation: large commands make less torque than asked."""

from __future__ import annotations

import numpy as np

from servod.formats.model.effects import TorqueSaturation
from servod.lab.diagnose.effects.effect import Effect, simple
from servod.lab.diagnose.effects.hypothesis import Term, Unknown
from servod.lab.diagnose.effects.looks import Look
from servod.lab.diagnose.effects.search_context import SearchContext

#: Quantiles of the command at which a limit is looked for.
QUANTILES = (0.9, 0.97, 0.995)

#: Quantile of the command under which no limit can be: a drive that is at its limit more often drives nothing.
LOWEST = 0.6


def terms(scene: SearchContext) -> list[Term]:
    """A hard limit from some quantiles of the command, and a smooth one; none beside a servo's own, its full duty."""
    found: list[Term] = []
    if scene.servo:
        return found
    most = float(np.max(np.abs(scene.torque)))
    least = max(float(np.quantile(np.abs(scene.torque), LOWEST)), 0.01 * most)
    for quantile in QUANTILES:
        limit = max(float(np.quantile(np.abs(scene.torque), quantile)), 0.05 * most)
        unknown = Unknown("limit", scene.force, max(0.9 * limit, least), least, 1.05 * most)
        found.append(simple("torque_saturation", "hard", [unknown], shape="hard"))
    for factor in (0.7, 1.5):
        unknown = Unknown("limit", scene.force, max(factor * most, least), least, 4.0 * most)
        found.append(simple("torque_saturation", "tanh", [unknown], shape="tanh"))
    return found


EFFECT = Effect(
    name="torque_saturation",
    group=TorqueSaturation,
    equation="torque = clip(torque, -limit, limit), or limit*tanh(torque/limit)",
    source="current limits; saturation of the iron: Krause et al., Analysis of Electric Machinery, 2013",
    statement="Large commands make less torque than they ask for: the torque saturates",
    shows="a mismatch against the command at the largest commands alone",
    confused=("viscous_nonlinear", "torque_gain", "actuator_lag"),
    experiment="short steps of growing command at rest or low speed",
    terms=terms,
    look=Look("load"),
    far=True,
    swift=True,
    soaks_up=True,
)
