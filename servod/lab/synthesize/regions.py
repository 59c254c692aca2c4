"""The region of poles that decay and damping ask for, as the one disc that an LMI can hold.

Stands under the LMIs. The set |z| <= rho, |z| <= exp(-zeta/sqrt(1 - zeta^2)*|arg z|) is not convex; the largest disc in
it that touches rho on the real axis is an inner approximation, so what the disc proves also holds for the set.
"""

from __future__ import annotations

import math

import numpy as np

from servod.formats.gains.design import Uncertainty
from servod.formats.model.axis_model import AxisModel
from servod.kernels.laws.local import COMMANDS
from servod.lab.verify.sampled import WHOLE
from servod.lab.verify.vertices import FLOORS, least_widths, measured_widths

STEPS = 40
#: Speeds between which the regions' gains blend [rad/s]: below the fall of the Stribeck curve of the paper's joint.
OVERLAP_RAD_S = (0.005, 0.02)


def pole_disc(least_decay_per_s: float, least_damping: float, period_s: float) -> tuple[float, float]:
    """(centre, radius) of the disc for a decay of at least `least_decay_per_s` and a damping ratio of at least that."""
    rho = math.exp(-least_decay_per_s * period_s)
    spiral = least_damping / math.sqrt(1.0 - least_damping**2)
    circle = np.exp(1j * np.linspace(0.0, math.pi, 721))
    low, high = 0.0, rho
    for _ in range(STEPS):
        radius = 0.5 * (low + high)
        z = rho - radius + radius * circle
        inside = bool(np.all(np.abs(z) <= np.exp(-spiral * np.abs(np.angle(z))) + 1e-12))
        low, high = (radius, high) if inside else (low, radius)
    return rho - low, low


# --- Half widths -----------------------------------------------------------------------------------------------------
# Half widths of the design's intervals: those that an identification measured, stated defaults for the rest. What was
# measured is taken as wide as it was measured, and never narrower than a floor: an axis warms, and is not the same
# tomorrow. Torques are identified in units of the command, so the torque gain is in every other number and has no
# interval of its own.


#: The design's file takes no wider share. What was measured wider than this stays wider than the design, which then
#: is not certified: `servoctl verify` compares both.
MOST = 0.85


def uncertainty_of(model: AxisModel) -> Uncertainty:
    """The intervals of `model`: identified half widths, but at least the floors; else the defaults."""
    if model.identified is None:
        return Uncertainty()
    bounded = {key: min(max(width, FLOORS[key]), MOST) for key, width in measured_widths(model).items()}
    if "delay_s" in bounded:
        bounded["delay_s"] = min(bounded["delay_s"], model.total_delay_s, 0.01)
    return Uncertainty(torque_gain=0.0, **bounded)


def narrowed(uncertainty: Uncertainty, factor: float, model: AxisModel) -> Uncertainty:
    """`uncertainty` times a factor below one, but nowhere narrower than a certificate of `model` allows."""
    allowed = {key: max(measured_widths(model).get(key, 0.0), least) for key, least in least_widths(model).items()}
    scaled = uncertainty.scaled(factor)
    kept = {key: min(getattr(uncertainty, key), max(getattr(scaled, key), least)) for key, least in allowed.items()}
    return scaled.model_copy(update=kept)


# --- Axes that are too late ------------------------------------------------------------------------------------------
# Axes whose torque comes so late that nothing is designed for them: said at once, with what would help. The LMIs of the
# deployed mode have a state for every command on its way.


#: Cycles of delay up to which a design is tried. The law feeds the last three commands back; with four the paper's
#: joint has no feedback for Omega_H any more, and from six on the LMIs of an easier axis take minutes.
LONGEST_CYCLES = 5.0


def delay_refusal(model: AxisModel, period_s: float) -> str | None:
    """Why no design is tried for the delay of `model` at this cycle; None where it is short enough."""
    late_s = model.acts_after_s
    cycles = late_s / period_s
    if cycles <= LONGEST_CYCLES + WHOLE:
        return None
    remedy = f"a cycle of {1e3 * late_s / LONGEST_CYCLES:.3g} ms and more has it within that"
    return (
        f"too much delay: {1e3 * late_s:.3g} ms are {cycles:.3g} cycles, and the law, which feeds "
        f"{COMMANDS} commands back, is designed for up to {LONGEST_CYCLES:g}; {remedy}"
    )
