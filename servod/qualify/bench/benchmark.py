"""Times the control laws as the loop runs them: plain Python floats through `engine.Controller`, one call per cycle.

Off the data path; `servoctl bench` prints the result. Nothing here asserts a time: machines differ.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

from servod.kernels.laws import LAWS, Law
from servod.runtime.loop.controller import Controller

PERIOD_S = 0.001
_NODES = (-0.5, -0.2, -0.01, -0.001, 0.0, 0.001, 0.05, 0.12, 0.5)
_LOCAL_HEAD = (0.1, 0.017, 1574.9, 0.241, 21.615, 197.0, 2.104, 0.005, 0.02, 760.0, 0.056, 2.0, 1.6e-4, 0.0, 0.0, 0.0)
_OBSERVER, _MEMORY, _REST = (50.0, 0.001, 0.1), (0.4, 0.3, 0.0), (1e-5, 0.3)
_LOCAL_TAIL = (2e-5, 0.001, *_OBSERVER, *_MEMORY, *_MEMORY, 50.0, 0.02, *_REST, 50.0, float(len(_NODES)))

#: Typical parameters with every option that costs time switched on; `local` has the paper's nine sets.
PARAMETERS: dict[str, tuple[float, ...]] = {
    "pd": (2.5, 0.12, 0.001),
    "pd_dob": (2.5, 0.12, 0.001, 50.0, 0.001, 0.0, 0.1, 2e-5),
    "pd_lugre": (2.5, 0.12, 0.001, 760.0, 1.0, 0.056, 0.045, 0.07, 0.1, 0.2, 0.1, 2e-5, 1.6e-4),
    "local": (*_LOCAL_HEAD, *_LOCAL_TAIL, *_NODES, *(14_000.0 * abs(v) for v in _NODES), *([0.04] * len(_NODES))),
}


@dataclass(frozen=True, slots=True)
class ControllerTiming:
    """Time of one controller step in microseconds."""

    law: str
    median_us: float
    p99_us: float


def controller_benchmark(n_steps: int = 20_000, laws: Sequence[str] = tuple(LAWS)) -> list[ControllerTiming]:
    """Step each law `n_steps` times along trajectory (19) and report the time of a step, law by law."""
    return [_timing(LAWS[name], PARAMETERS[name], n_steps) for name in laws]


def _timing(law: Law, parameters: tuple[float, ...], n_steps: int) -> ControllerTiming:
    controller = Controller()
    controller.activate(law.number, parameters, 0.0)
    durations_ns, torque, omega = [], 0.0, 0.2 * math.pi
    for k in range(n_steps):
        phase = omega * PERIOD_S * k
        x_ref, v_ref, a_ref = (0.1 * math.sin(phase), 0.1 * omega * math.cos(phase), -0.1 * omega**2 * math.sin(phase))
        begin = time.perf_counter_ns()
        torque = controller.step(x_ref, v_ref, a_ref, x_ref - 1e-5, 0.99 * v_ref, torque, PERIOD_S).u
        durations_ns.append(time.perf_counter_ns() - begin)
    durations_ns.sort()
    return ControllerTiming(law.name, durations_ns[n_steps // 2] / 1e3, durations_ns[n_steps * 99 // 100] / 1e3)
