"""The stepped axis that the benchmark measures: the demo's joint under its local-model law."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from servod.client.stepped import SteppedSession
from servod.formats.gains.gain_set import GainSet, load_gains
from servod.qualify.demo.axis import demo_config, gains_file, plant_file

if TYPE_CHECKING:
    from servod.drivers.virtual.world import SteppedWorld


def local_gains() -> GainSet:
    """The gain set that all figures are measured with."""
    return load_gains(gains_file("local"))


@contextmanager
def stepped_session(wrap: type | None = None) -> Iterator[SteppedSession]:
    """An enabled session; `wrap` may stand between it and the world, to look at its frames."""
    from servod.drivers.virtual.world import SteppedWorld, VirtualAxisSettings
    from servod.formats.model.axis_model import load_axis_model

    gains = local_gains()
    world: SteppedWorld = SteppedWorld(VirtualAxisSettings(), load_axis_model(plant_file(None)))
    with TemporaryDirectory(prefix="servod-bench-") as folder:
        config = demo_config(Path(folder), Path(folder))
        session = SteppedSession(config, world if wrap is None else wrap(world), gains.law.number, gains.pack())
        session.enable()
        yield session
