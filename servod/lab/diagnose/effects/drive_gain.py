"""Gain of a servo: its loop makes more or less duty of an error than the model says."""

from __future__ import annotations

import math

from servod.lab.diagnose.effects.base import RECALIBRATION
from servod.lab.diagnose.effects.effect import Effect, of_drive, positive
from servod.lab.diagnose.effects.hypothesis import Document, Term, get
from servod.lab.diagnose.effects.looks import Look
from servod.lab.diagnose.effects.search_context import SearchContext

#: By which factor a gain may be another: firmware counts in 4096ths, in 32nds, in per cent.
MOST = 20.0


def terms(scene: SearchContext) -> list[Term]:
    """One factor on all gains of the loop."""
    if not scene.servo:
        return []
    own = get(scene.document, "drive.gain_scale", 1.0)
    return [of_drive("drive_gain", "scale", [positive("gain_scale", "1", own, MOST)])]


def _at_level(nominal: Document, fitted: Document) -> bool:
    was, now = (get(document, "drive.gain_scale", 1.0) for document in (nominal, fitted))
    return abs(math.log(now / was)) >= math.log(1.0 + RECALIBRATION)


EFFECT = Effect(
    name="drive_gain",
    group=None,
    equation="duty = gain_scale*(kp*error + ki*integral(error)) - gain_scale*kd*speed",
    source="units of a servo's gains, which its firmware scales",
    statement="The servo's loop has another gain than the model says",
    shows="a mismatch in proportion to the error where the duty is below its limit, and none at it",
    confused=("torque_gain", "goal_rate", "drive_dead_band"),
    experiment="goals near and far: far ones are at the limit of the duty, where the gain does nothing",
    terms=terms,
    look=Look("load"),
    drive_keys=("gain_scale",),
    far=True,
    one_with=("drive.kp",),
    product_with="torque_gain",
    at_level=_at_level,
)
