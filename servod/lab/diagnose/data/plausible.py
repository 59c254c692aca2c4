"""Whether sign and units of a recording can be right: the command against the torque that the model's motion needs.

Stands beside `intake`. The command is split by least squares into the model's inertial and viscous part, its dry
friction, and what may be missing anywhere (a constant, and slow curves over position), so that physics that was left
out is not taken for a wrong unit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from servod.formats.model.axis_model import AxisKind, AxisModel
from servod.lab.diagnose.data.trace import Trace
from servod.lab.diagnose.predict.predict import dry_friction

#: A factor by which a unit is off at least, and by how much the factors of two parts may differ and be one unit.
WRONG_UNIT, ALIKE = 5.0, 3.0

#: Standard errors, rows that count as one, and the share of the command that must be understood.
SURE, MEMORY, UNDERSTOOD = 8.0, 20.0, 0.5

#: Degrees in a radian.
DEGREES = 180.0 / math.pi


@dataclass(frozen=True)
class Factor:
    """By how much one part of the needed torque stands in the command, with its standard error."""

    value: float
    error: float

    @property
    def sure(self) -> bool:
        """Whether it differs from nothing for certain."""
        return abs(self.value) > SURE * self.error


def implausible(trace: Trace, model: AxisModel) -> str | None:
    """A sign or a unit that cannot be, in one line; None when nothing speaks against the recording."""
    moved, dry, understood = factors(trace, model)
    if understood < UNDERSTOOD:
        return None
    if dry.sure and dry.value < 0.0 and (moved.value < 0.0 or not moved.sure):
        return f"command and motion have opposite signs (friction stands in the command times {dry.value:.3g})"
    if not (moved.sure and dry.sure):
        return None
    apart = max(moved.value / dry.value, dry.value / moved.value) if moved.value * dry.value > 0.0 else math.inf
    scale = math.sqrt(abs(moved.value * dry.value))
    if apart < ALIKE and not 1.0 / WRONG_UNIT < scale < WRONG_UNIT:
        return f"the command is {scale:.3g} times what the model needs: another unit, or another axis"
    if moved.value > 0.0 and 1.0 / ALIKE < dry.value < ALIKE:
        return _position_unit(moved.value, model)
    return None


def _position_unit(moved: float, model: AxisModel) -> str | None:
    """Friction is as it should be, and what goes with the size of the motion is not."""
    if model.axis is AxisKind.ROTARY and 1.0 / ALIKE < moved * DEGREES < ALIKE:
        return f"the position looks like degrees: the motion needs {1.0 / moved:.3g} times the command"
    if moved < 0.25 / DEGREES:
        return f"the position looks like counts or another unit: the motion needs {1.0 / moved:.3g} times the command"
    return None


def factors(trace: Trace, model: AxisModel) -> tuple[Factor, Factor, float]:
    """Factors of motion (inertia and viscous friction) and of dry friction in the command, and the share understood."""
    x, v = trace.drive.position, trace.velocity
    rows = trace.counts & np.isfinite(v)
    slow = max(0.05 * float(np.std(v[rows])), 1e-12)
    motion = model.inertia * trace.acceleration + model.friction.viscous * v
    place = (x - float(np.mean(x[rows]))) / max(float(np.std(x[rows])), 1e-12)
    parts = [motion, dry_friction(model) * np.tanh(v / slow), np.ones_like(x), place, place**2, place**3]
    if model.gravity is not None:
        parts.append(np.sin(x + model.gravity.phase))
    design, command = np.column_stack(parts)[rows], trace.drive.torque[rows]
    size = np.maximum(np.sqrt(np.mean(design**2, axis=0)), 1e-30)
    found, *_ = np.linalg.lstsq(design / size, command, rcond=None)
    left = command - design / size @ found
    free = max(len(command) / MEMORY - len(found), 1.0)
    spread = np.linalg.pinv((design / size).T @ (design / size)) * len(command)
    errors = np.sqrt(np.maximum(np.diag(spread), 0.0) * float(np.mean(left**2)) / free) / size
    values = found / size
    understood = 1.0 - float(np.var(left)) / max(float(np.var(command)), 1e-30)
    return Factor(float(values[0]), float(errors[0])), Factor(float(values[1]), float(errors[1])), understood
