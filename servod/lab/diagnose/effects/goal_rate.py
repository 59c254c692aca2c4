"""Goal rate: a servo goes after its goal no faster than some speed."""

from __future__ import annotations

import numpy as np

from servod.lab.diagnose.effects.effect import Effect, of_drive, positive
from servod.lab.diagnose.effects.hypothesis import Term
from servod.lab.diagnose.effects.looks import Look
from servod.lab.diagnose.effects.search_context import SearchContext

#: Rates to start from, as shares of a high speed of the motion: where the goal runs away, it follows at the rate.
STARTS = (0.7, 1.0, 1.4)

#: A goal that never moves so many times as fast shows no rate.
LEAST_FASTER = 1.2


def terms(scene: SearchContext) -> list[Term]:
    """Some starts below the fastest that the goal moves; none where the goal is no slower than the axis."""
    if not scene.servo or scene.document["drive"].get("goal_rate") is not None:
        return []
    fastest = max(
        float(np.max(np.abs(np.diff(trace.drive.told.command)) / np.maximum(np.diff(trace.drive.t_s), 1e-9)))
        for trace in scene.predictor.traces
        if trace.drive.told is not None
    )
    starts = [start * scene.speed for start in STARTS if LEAST_FASTER * start * scene.speed < fastest]
    unit = f"{scene.length}/s"
    return [of_drive("goal_rate", "limited", [positive("goal_rate", unit, start, 20.0)]) for start in starts]


EFFECT = Effect(
    name="goal_rate",
    group=None,
    equation="goal followed: |d(goal)/dt| <= goal_rate",
    source="profile speed of a servo's firmware; Feetech STS, Dynamixel profile velocity",
    statement="The servo goes after its goal no faster than a fixed speed",
    shows="a mismatch behind fast changes of the goal alone, which ends when the goal is reached",
    confused=("delay", "drive_gain", "viscous_nonlinear"),
    experiment="steps of the goal of several sizes: the time to the new goal grows with the size",
    terms=terms,
    look=Look("change of the command"),
    drive_keys=("goal_rate",),
    far=True,
    swift=True,
)
