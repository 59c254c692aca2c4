"""What these recordings say of the model's own parameters: which have changed, in numbers, in a sentence, in the model.

Stands between the evidence and the document.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servod.lab.diagnose.engine import Evidence
from servod.lab.diagnose.judge.spread import within

Array = NDArray[np.float64]

#: Half width of a 95 % interval in standard deviations.
Z95 = 1.96

#: A change of a parameter below this share is none.
LEAST_CHANGE = 0.002


def recalibrated(evidence: Evidence) -> dict[str, Any]:
    """Parameters of the model itself that were off: from, to, 95 % interval. Those of a finding are not here."""
    fit = evidence.fit
    opened = {key for place in evidence.named for key in fit.hypothesis.terms[place].opens}
    found = {}
    for index, (unknown, nominal) in enumerate(zip(fit.hypothesis.unknowns, fit.hypothesis.base, strict=False)):
        value = fit.values[index]
        deviation = math.sqrt(max(float(evidence.spread[index, index]), 0.0))
        size = unknown.size if unknown.size else abs(value)
        if unknown.key in opened or abs(value - nominal.start) <= max(LEAST_CHANGE, Z95 * deviation) * size:
            continue
        half = Z95 * deviation * size
        entry = {"from": nominal.start, "to": value, "unit": unknown.unit, "interval": [value - half, value + half]}
        found[unknown.key] = entry
    return found


def told_coordinates(evidence: Evidence) -> Array:
    """Coordinates of the model to hand out: what the report says, as long as that can be said.

    Where nothing has a name, parameters that are not told from what they were stay what they were: those of an axis
    that was identified are worth more than what one short recording makes of them. That holds as long as all of them
    together lie in the region of 95 % around the fit; beyond it, the fit.
    """
    fit = evidence.fit
    if fit.hypothesis.terms or evidence.unnamed is not None:
        return fit.coordinates
    changed = recalibrated(evidence)
    told = [unknown.key in changed for unknown in fit.hypothesis.base]
    back = np.where(told, 0.0, fit.coordinates - fit.hypothesis.start)
    return fit.coordinates - back if within(back, evidence.spread) else fit.coordinates


def differs(changes: Mapping[str, Any]) -> str:
    """What was recalibrated, as a sentence about these recordings; empty where nothing was."""
    said = []
    for name, change in changes.items():
        words = name.removeprefix("friction.").removesuffix(".per_s").removesuffix("_s").replace("_", " ")
        was, now, unit = change["from"], change["to"], change["unit"]
        share = f" ({100.0 * (now - was) / abs(was):+.2g} %)" if was != 0.0 else ""
        said.append(f"{words} is {now:.4g} instead of {was:.4g} {unit}{share}")
    return f"What differs from the model in these recordings: {'; '.join(said)}." if said else ""
