"""Actuator lag: the torque follows the command as a first-order lag, or at a limited rate."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from servod.formats.model.effects import ActuatorLag
from servod.lab.diagnose.effects.effect import Effect, known_delay, simple
from servod.lab.diagnose.effects.hypothesis import Term, Unknown
from servod.lab.diagnose.effects.looks import Look
from servod.lab.diagnose.effects.search_context import SearchContext

#: Time constants to start from, s.
STARTS_S = (0.002, 0.006, 0.02)

#: Rate limits to start from: from this share of the command's changes that are slower up to the greatest of them, each
#: by this factor above the one before. One too high acts nowhere, and one a little too low hardly looks better.
OFTEN, NEXT_RATE, MOST_RATES = 0.98, 1.1, 16


def terms(scene: SearchContext) -> list[Term]:
    """A lag from some time constants, and a limited rate; none where a servo's own loop makes the torque.

    There the motor's time constant is a millisecond or two, and what comes late is the goal: a delay.
    """
    if scene.servo:
        return []
    own = known_delay(scene.document)
    lags = [simple("actuator_lag", "lag", [Unknown("time_constant_s", "s", start, 1e-5, 0.5)]) for start in STARTS_S]
    step = np.abs(np.diff(scene.torque)) / max(trace.period_s for trace in scene.predictor.traces)
    often, most = (max(float(np.quantile(step, share)), 1e-9) for share in (OFTEN, 1.0))
    count = min(max(math.ceil(math.log(most / often) / math.log(NEXT_RATE)), 1), MOST_RATES)
    rates = [
        Unknown("slew_per_s", f"{scene.force}/s", float(start), 0.01 * often, 20.0 * most)
        for start in np.geomspace(often, most, count)
    ]
    limits = [simple("actuator_lag", "rate limit", [rate]) for rate in rates]
    return [replace(term, opens=own) for term in (*lags, *limits)]


EFFECT = Effect(
    name="actuator_lag",
    group=ActuatorLag,
    equation="dT/dt = (command - T)/time_constant_s, |dT/dt| <= slew_per_s",
    source="current loop bandwidth; hydraulic and pneumatic drives",
    statement="The torque follows the command with a lag",
    shows="a mismatch in proportion to the change of the command, less at the highest frequencies than a delay's",
    confused=("delay", "joint_elasticity", "torque_saturation"),
    experiment="steps of command, sampled faster than the lag: dead time waits, lag begins at once",
    terms=terms,
    look=Look("change of the command"),
    far=True,
    swift=True,
    twin="delay",
    lateness="actuator_lag.time_constant_s",
)
