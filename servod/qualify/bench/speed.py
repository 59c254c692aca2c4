"""How much faster than real time: the whole closed loop with CAN frames, SYNC-stepped; and the compiled simulator."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from servod.client.stepped import ListPort, SteppedSession
from servod.formats.gains.gain_set import GainSet, load_gains
from servod.qualify.demo.axis import demo_config, gains_file, plant_file
from servod.runtime.loop.commands import Op, ReferenceKind

if TYPE_CHECKING:
    from servod.drivers.virtual.world import SteppedWorld

# --- The axis of the benchmark ---------------------------------------------------------------------------------------
# The stepped axis that the benchmark measures: the demo's joint under its local-model law.


def local_gains() -> GainSet:
    """The gain set that all figures are measured with."""
    return load_gains(gains_file("local"))


@contextmanager
def stepped_session(wrap: type | None = None, port: type[ListPort] = ListPort) -> Iterator[SteppedSession]:
    """An enabled session; `wrap` may stand between it and the world, to look at its frames."""
    from servod.drivers.virtual.world import SteppedWorld, VirtualAxisSettings
    from servod.formats.model.axis_model import load_axis_model

    gains = local_gains()
    world: SteppedWorld = SteppedWorld(VirtualAxisSettings(), load_axis_model(plant_file(None)))
    with TemporaryDirectory(prefix="servod-bench-") as folder:
        config = demo_config(Path(folder), Path(folder))
        wrapped = world if wrap is None else wrap(world)
        session = SteppedSession(config, wrapped, gains.law.number, gains.pack(), port(world.clock))
        session.enable()
        yield session


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
    simulate_closed_loop(model, gains.law, gains.pack(), reference[:1000])
    started = time.perf_counter()
    simulate_closed_loop(model, gains.law, gains.pack(), reference)
    return duration_s / (time.perf_counter() - started)
