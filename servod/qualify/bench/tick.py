"""The work of one cycle without waiting: decode, axis, controller, limits, encode, record; and the controller alone.

The loop's own Cycle runs in a stepped session; what its calls to the bus take, where the virtual world computes, is
measured too and left out. On a real bus the system calls for sending and receiving come on top.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from servod.client.stepped import ChannelPort
from servod.common.clock import Clock
from servod.common.units import NS_PER_US
from servod.kernels.laws import LAWS, Law
from servod.qualify.bench.speed import stepped_session
from servod.runtime.fieldbus.bus import Bus, Frame
from servod.runtime.loop.commands import Op, ReferenceKind
from servod.runtime.loop.controller import Controller

# --- Control laws ----------------------------------------------------------------------------------------------------
# Times the control laws as the loop runs them: plain Python floats through `engine.Controller`, one call per cycle.
# `servoctl bench` prints the result. Nothing here asserts a time: machines differ.


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


_WARM_UP = 500


class _Stopwatch:
    """A world whose buses add up the time spent in them."""

    def __init__(self, world: Any) -> None:
        self._world = world
        self.clock: Clock = world.clock
        self.spent_ns = 0

    def connect(self, can_ids: tuple[int, ...] | None = None) -> _TimedBus:
        """A connection whose time counts."""
        return _TimedBus(self._world.connect(can_ids), self)


class _TimedBus:
    """Passes everything on and adds the time that it takes to its stopwatch."""

    def __init__(self, bus: Bus, stopwatch: _Stopwatch) -> None:
        self._bus, self._stopwatch = bus, stopwatch
        self.counters = bus.counters

    def send(self, can_id: int, data: bytes) -> bool:
        """As Bus.send."""
        started = time.perf_counter_ns()
        done = self._bus.send(can_id, data)
        self._stopwatch.spent_ns += time.perf_counter_ns() - started
        return done

    def receive(self, timeout_s: float = 0.0) -> Frame | None:
        """As Bus.receive."""
        started = time.perf_counter_ns()
        frame = self._bus.receive(timeout_s)
        self._stopwatch.spent_ns += time.perf_counter_ns() - started
        return frame

    def fileno(self) -> int:
        """As Bus.fileno."""
        return self._bus.fileno()

    def close(self) -> None:
        """As Bus.close."""
        self._bus.close()


def measure(ticks: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """Median and p99 in us of the whole tick, and of the controller's step alone, over `ticks` cycles each."""
    return _whole_tick(ticks), _controller(ticks)


def _whole_tick(ticks: int) -> dict[str, Any]:
    with stepped_session(_Stopwatch, ChannelPort) as session:
        stopwatch: Any = session.world
        session.send(Op.REFERENCE, [ReferenceKind.SINE, 0.05, 0.5, 3600.0])
        cycle, clock, period_ns = session.cycle, session.clock, session.cycle.period_ns
        session.run(0.1)
        deadline_ns, times_ns = clock.now_ns() + period_ns, []
        for _ in range(ticks + _WARM_UP):
            clock.sleep_until(deadline_ns)
            stopwatch.spent_ns = 0
            started = time.perf_counter_ns()
            cycle.step(deadline_ns, deadline_ns, 0)
            times_ns.append(time.perf_counter_ns() - started - stopwatch.spent_ns)
            deadline_ns += period_ns
            session.port.look()  # the supervisor's work, which is not the cycle's
        session.clear()
    return _figures(times_ns)


def _controller(ticks: int) -> dict[str, Any]:
    """The local-model law with the paper's nine sets; the other laws beside it."""
    timings = {timing.law: timing for timing in controller_benchmark(ticks)}
    medians = {law: timing.median_us for law, timing in timings.items()}
    return {"median": medians["local"], "p99": timings["local"].p99_us, "cycles": ticks, "median_by_law": medians}


def _figures(times_ns: list[int]) -> dict[str, Any]:
    times_us = sorted(t / NS_PER_US for t in times_ns[_WARM_UP:])
    count = len(times_us)
    return {"median": times_us[count // 2], "p99": times_us[int(0.99 * count)], "cycles": count}
