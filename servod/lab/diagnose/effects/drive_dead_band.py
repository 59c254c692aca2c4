"""Dead band of a servo: small errors of the position make no duty."""

from __future__ import annotations

import numpy as np

from servod.lab.diagnose.effects.effect import Effect, of_drive
from servod.lab.diagnose.effects.hypothesis import Term, Unknown
from servod.lab.diagnose.effects.looks import Look
from servod.lab.diagnose.effects.search_context import SearchContext

#: Quantiles of the error at which a band is looked for.
QUANTILES = (0.1, 0.25, 0.45)

#: The step of derivatives, as a share of the band: each row leaves the band at once, and only some rows leave it.
NUDGE = 0.1


def terms(scene: SearchContext) -> list[Term]:
    """A band from some quantiles of the error; none where the servo follows a speed."""
    if not scene.servo or scene.document["drive"]["kind"] != "position_servo":
        return []
    drives = [trace.drive for trace in scene.predictor.traces if trace.drive.told is not None]
    error = np.abs(np.concatenate([drive.told.command - drive.position for drive in drives if drive.told is not None]))
    found = []
    for start in (max(float(np.quantile(error, quantile)), 1e-9) for quantile in QUANTILES):
        band = Unknown("dead_band", scene.length, start, 0.0, 20.0 * start, start, nudge=NUDGE)
        found.append(of_drive("drive_dead_band", "band", [band]))
    return found


EFFECT = Effect(
    name="drive_dead_band",
    group=None,
    equation="duty = 0 where |goal - position| <= dead_band",
    source="dead zone of a servo's firmware",
    statement="The servo does nothing about small errors: it has a dead band",
    shows="a mismatch at small errors alone, as large as the duty that they should make",
    confused=("stribeck", "backlash", "presliding"),
    experiment="slow moves of the goal, smaller than the band and larger",
    terms=terms,
    look=Look("position"),
    drive_keys=("dead_band",),
    swift=True,
)
