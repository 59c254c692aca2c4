"""A linear slide with the size and friction of a published ball-screw axis, and its free run from rest, made here."""

from __future__ import annotations

from typing import Any

import numpy as np

from servod.lab.simulate.replay import Drive

SLIDE: dict[str, Any] = {
    "axis": "linear",
    "inertia": 95.0,
    "delay_s": 0.0,
    "friction": {"kind": "coulomb_viscous", "viscous": 200.0, "coulomb": 20.0},
    "torque_offset": 3.0,
}


def set_off(missed: int, seconds: float = 2.0) -> Drive:
    """Rows at 1 ms of a slide that leaves its rest as the force rises; the recorder missed the first `missed` ms.

    Integrated here with steps of 10 us and nothing of the kernels. The force jumps to 60 N, rises to 120 N within 20 ms
    and swings once a second from then on.
    """
    t = np.arange(0.0, seconds, 1e-3)
    force = np.where(t < 0.02, 60.0 + 3000.0 * t, 120.0 * np.cos(2.0 * np.pi * (t - 0.02)))
    position, x, v = np.zeros(len(t)), 0.0, 0.0
    for k in range(len(t)):
        position[k] = x
        for _ in range(100):
            free = v + 1e-5 / 95.0 * (force[k] + 3.0 - 200.0 * v)
            grip = 1e-5 / 95.0 * 20.0
            faster = 0.0 if abs(free) <= grip else free - np.copysign(grip, free)
            x, v = x + 0.5e-5 * (v + faster), faster
    position = np.round(position / 1e-8) * 1e-8
    return Drive(t[missed:], force[missed:], position[missed:], np.full(len(t) - missed, np.nan))
