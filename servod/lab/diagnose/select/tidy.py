"""Puts parameters back that were moved for nothing: where the nominal value does as well, it stands.

Stands between the selection and the proof. Stiffness and damping of the bristle, the Stribeck curve, offset and delay
show little in most recordings; a value that noise or the sample time has moved is no recalibration.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from servod.lab.diagnose.effects.hypothesis import Hypothesis
from servod.lab.diagnose.select.choose import Chooser
from servod.lab.diagnose.select.fit import Fit

#: Parameters that are put back where the data do not mind.
LEVELS = (
    "friction.sigma0",
    "friction.sigma1",
    "friction.static",
    "friction.stribeck_velocity",
    "torque_offset",
    "delay_s",
)

#: They mind when the torque that changes is over this share of dry friction in some rows, or the error grows by this.
MINDS, GROWS = 0.01, 0.02

#: Belief so firm that a parameter stays.
FIRM = 1e-6


def tidied(chooser: Chooser, fit: Fit) -> Fit:
    """The fit with as many of LEVELS at their nominal values as the data do not mind; those that a term opens stay.

    They are held for the fit alone: what is known of them, and so every interval, stays as it was.
    """
    opened = {key for term in fit.hypothesis.terms for key in term.opens}
    candidates = [key for key in LEVELS if key not in opened and any(u.key == key for u in fit.hypothesis.base)]
    tidy = fit
    for keys in [candidates, *[[key] for key in candidates]]:
        held = _held(chooser, tidy, keys)
        if held is not None:
            tidy = held
            if keys is candidates:
                break
    return fit if tidy is fit else chooser.fresh(replace(tidy, hypothesis=fit.hypothesis))


def _held(chooser: Chooser, fit: Fit, keys: list[str]) -> Fit | None:
    """The fit with `keys` at their nominal values, None where the data mind."""
    base = tuple(replace(u, spread=FIRM) if u.key in keys else u for u in fit.hypothesis.base)
    hypothesis = Hypothesis(fit.hypothesis.document, base, fit.hypothesis.terms)
    at = fit.coordinates.copy()
    for index, unknown in enumerate(base):
        if unknown.key in keys:
            at[index] = unknown.coordinate(unknown.start)
    fitter = chooser.fitter(fit.mismatch)
    begun = fitter.begin(hypothesis, at, fit.jacobian)
    if begun is None:
        return None
    held = fitter.refine(begun, 3, len(at))
    changed = np.abs(held.mismatch - fit.mismatch)[chooser.predictor.counts]
    if float(np.quantile(changed, 0.99)) > MINDS * chooser.predictor.dry:
        return None
    return held if chooser.error(held.mismatch) <= (1.0 + GROWS) * chooser.error(fit.mismatch) else None
