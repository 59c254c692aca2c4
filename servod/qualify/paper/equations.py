"""Printed against consistent equations: (18) with its sign, (8) taken literally, (15) as it stands.

Jobs of the pool; each gives figures that say what the slip does, none is used elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from servod.formats.gains.gain_set import GainSet
from servod.lab.synthesize.local_sets import STIFFNESS_SHARE, Compensator, force_after
from servod.qualify.paper.joints import PaperJoint, at_paper_feedback, consistent_g, printed_g, shipped_set, with_decays
from servod.qualify.paper.printed import FRICTION
from servod.qualify.paper.sweeps import rms_mrad

#: t_f of (8); the paper prints none. Long against 1/a_i, as its slow sines are.
FINAL_TIME_S = 1.0
#: Speeds of the sets that hold (18) in either form, in each direction; trajectory (19) peaks at 0.063 rad/s.
FINE_SPEEDS = tuple(float(v) for v in np.geomspace(1e-3, 0.1, 12))
SPEEDS_TOLD = (0.01, 0.063, 0.2, 0.5)


@dataclass(frozen=True)
class TwoForms:
    """One slip: what both forms give at some speeds [N*m], and what tracking (19) with each costs [mrad RMS]."""

    speeds: tuple[float, ...]
    printed_nm: tuple[float, ...]
    consistent_nm: tuple[float, ...]
    printed_mrad: float
    consistent_mrad: float


def compensator() -> Compensator:
    """c0_hat and d0_hat of the shipped sets of Table I."""
    return Compensator(STIFFNESS_SHARE * FRICTION.sigma0, FRICTION.viscous)


def exponent_of_18(seconds: float) -> TwoForms:
    """The local law at the paper's PD gains, its sets made from g(v) as printed and with the exponent's sign mended."""
    c, plant = compensator(), PaperJoint.TABLE1.model()
    nodes, base = _both_directions(FINE_SPEEDS), _plain()

    def tracked(name: str, g_of_speed: Callable[[float], float]) -> float:
        gains = with_decays(base, name, lambda v: c.stiffness * abs(v) / g_of_speed(abs(v)), nodes)
        return rms_mrad(plant, gains, seconds)

    return TwoForms(
        SPEEDS_TOLD,
        tuple(printed_g(v) for v in SPEEDS_TOLD),
        tuple(consistent_g(v) for v in SPEEDS_TOLD),
        tracked("printed_18", printed_g),
        tracked("consistent_18", consistent_g),
    )


def literal_8(seconds: float) -> TwoForms:
    """a_i by (8) taken literally, from the innermost set outwards, and by (7) on the map.

    On sets dense enough that what the nine of Table I leave between them does not count.
    """
    c, plant, base = compensator(), PaperJoint.TABLE1.model(), _plain()
    nodes = _both_directions(FINE_SPEEDS)
    force = consistent_g(FINE_SPEEDS[0]) + FRICTION.viscous * FINE_SPEEDS[0]
    literal = {v: equal_force_decay(c, force, abs(v)) for v in (*nodes, *SPEEDS_TOLD) if v}
    by_map = {v: c.stiffness * abs(v) / consistent_g(abs(v)) for v in (*nodes, *SPEEDS_TOLD) if v}
    return TwoForms(
        SPEEDS_TOLD,
        tuple(c.torque(literal[v], v) for v in SPEEDS_TOLD),
        tuple(c.torque(by_map[v], v) for v in SPEEDS_TOLD),
        rms_mrad(plant, with_decays(base, "literal_8", literal.__getitem__, nodes), seconds),
        rms_mrad(plant, with_decays(base, "by_7", by_map.__getitem__, nodes), seconds),
    )


def equal_force_decay(c: Compensator, force_nm: float, speed: float) -> float:
    """a_i with which (8) has `force_nm` on its other side: the set's torque after t_f equals it [1/s]."""
    return float(brentq(lambda a: force_after(c, a, speed, FINAL_TIME_S) - force_nm, 1e-6, 1e9, xtol=1e-9, rtol=1e-9))


def _both_directions(speeds: tuple[float, ...]) -> list[float]:
    return sorted({0.0, *speeds, *(-v for v in speeds)})


def _plain() -> GainSet:
    """Table I's local law under the paper's PD gains, without any l_i once its sets are replaced."""
    return at_paper_feedback(shipped_set("table1_kz_kv_kx"), "plain")
