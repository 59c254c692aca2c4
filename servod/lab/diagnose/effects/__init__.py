"""Every effect by its name, one file each; a new effect is a new file and one line in this table.

Lists of effects that search, verdict and report need are drawn from the records (`names`). Physics that the axis model
file cannot say yet also needs its group of keys there (`servod.formats.model`), which says how it is checked and
packed, and its torque in `servod.kernels.physics`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from importlib import import_module

from servod.lab.diagnose.data.excitation import creeps, unidirectional
from servod.lab.diagnose.data.trace import CheckedTrace
from servod.lab.diagnose.effects.effect import Effect

#: Names of the outside contract and our own (offset_drift, and those of a servo's drive), in the order in which they
#: are tried and explained.
NAMES: tuple[str, ...] = (
    "asymmetry",
    "stribeck",
    "presliding",
    "viscous_nonlinear",
    "load_dependent_friction",
    "position_dependent_friction",
    "cogging",
    "torque_ripple",
    "gravity",
    "spring",
    "backlash",
    "joint_elasticity",
    "torque_gain",
    "torque_saturation",
    "delay",
    "actuator_lag",
    "thermal",
    "inertia",
    "position_dependent_inertia",
    "encoder_eccentricity",
    "torque_offset",
    "disturbance",
    "dry_friction",
    "viscous_friction",
    "offset_drift",
    "goal_rate",
    "drive_gain",
    "drive_dead_band",
    "drive_integral",
)


@cache
def effect(name: str) -> Effect:
    """The effect of this name (one of NAMES)."""
    found: Effect = import_module(f"servod.lab.diagnose.effects.{name}").EFFECT
    return found


def effects() -> tuple[Effect, ...]:
    """All effects, in the order of NAMES."""
    return tuple(effect(name) for name in NAMES)


def names(which: Callable[[Effect], bool]) -> frozenset[str]:
    """Names of the effects of which `which` is true."""
    return frozenset(found.name for found in effects() if which(found))


def fitted_elsewhere(unknown: frozenset[str]) -> frozenset[str]:
    """Effects that cannot be told from a number of the drive that is fitted (`unknown`)."""
    return names(lambda found: not unknown.isdisjoint(found.one_with))


def unexcited_effects(traces: Sequence[CheckedTrace], inertia: float) -> frozenset[str]:
    """Effects that these recordings of an axis of this inertia cannot show."""
    slow, straight = creeps(traces, inertia), unidirectional(traces)
    return names(lambda found: (slow and found.swift) or (straight and found.directed))
