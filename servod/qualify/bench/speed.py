"""How much faster than real time: the whole closed loop with CAN frames, SYNC-stepped; and the compiled simulator."""

from __future__ import annotations

import time

from servod.qualify.bench.axis import local_gains, stepped_session
from servod.qualify.demo.axis import plant_file
from servod.runtime.loop.commands import Op, ReferenceKind

_WARM_UP_S = 0.5


def stepped(duration_s: float) -> float:
    """Virtual seconds per second of master, cycle and virtual world in one process, tracking a sine."""
    with stepped_session() as session:
        session.send(Op.REFERENCE, [ReferenceKind.SINE, 0.05, 0.5, 3600.0])
        session.run(_WARM_UP_S)
        started = time.perf_counter()
        session.run(duration_s)
        return duration_s / (time.perf_counter() - started)


def simulated(duration_s: float) -> float:
    """Simulated seconds per second of the closed loop with the plant's inner step; compiling is not counted."""
    import numpy as np

    from servod.formats.model.axis_model import load_axis_model
    from servod.lab.simulate.simulate import simulate_closed_loop

    gains, model, period_s = local_gains(), load_axis_model(plant_file(None)), 0.001
    time_s = np.arange(round(duration_s / period_s)) * period_s
    w = np.pi
    reference = np.stack(
        [0.05 * np.sin(w * time_s), 0.05 * w * np.cos(w * time_s), -0.05 * w * w * np.sin(w * time_s)], 1
    )
    simulate_closed_loop(model, gains.law.step, gains.pack(), reference[:1000])
    started = time.perf_counter()
    simulate_closed_loop(model, gains.law.step, gains.pack(), reference)
    return duration_s / (time.perf_counter() - started)
