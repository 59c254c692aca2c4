"""Integral part of a servo: a lasting error makes ever more duty."""

from __future__ import annotations

from servod.lab.diagnose.effects.effect import Effect, of_drive, positive
from servod.lab.diagnose.effects.hypothesis import Term
from servod.lab.diagnose.effects.looks import Look
from servod.lab.diagnose.effects.search_context import SearchContext

#: Times to start from, s, in which the integral part makes as much of an error as the proportional one.
STARTS_S = (1.0, 0.2)


def terms(scene: SearchContext) -> list[Term]:
    """An integral gain from some times; none where the model's servo has one."""
    if not scene.servo or scene.document["drive"].get("ki", 0.0) > 0.0:
        return []
    unit = f"1/({scene.length}·s)" if scene.document["drive"]["kind"] == "position_servo" else f"1/{scene.length}"
    gain = scene.servo_gain
    return [of_drive("drive_integral", "integral", [positive("ki", unit, gain / start_s)]) for start_s in STARTS_S]


EFFECT = Effect(
    name="drive_integral",
    group=None,
    equation="duty += gain_scale*ki*integral(goal - position), within the limit",
    source="integral gain of a servo's firmware, which is another than nothing",
    statement="The servo integrates its error: its loop has an integral part",
    shows="a mismatch that grows with the time for which an error lasts, and stays when the error is gone",
    confused=("gravity", "offset_drift", "drive_gain"),
    experiment="a goal held for seconds against a weight: the error creeps to nothing",
    terms=terms,
    look=Look("time"),
    drive_keys=("ki",),
)
