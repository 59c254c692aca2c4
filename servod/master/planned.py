"""What a configuration plans, without a bus: the drivers' set-up faces, their PDOs, and the load that these will make.

Off the control path. `servod --check` and `servoctl config check` refuse by it what the bring-up would refuse later.
"""

from __future__ import annotations

from typing import Literal

from servod.bus.load import BusLoad, bus_load, check_bus_load
from servod.config import AxisConfig
from servod.drivers import load_driver
from servod.errors import BadInput
from servod.hal import Driver, NodePlan, Setup

Kind = Literal["amplifier", "encoder"]


def load_setup(config: AxisConfig, kind: Kind) -> Setup:
    """The set-up face of the configured amplifier or encoder; raises BadInput for a driver of the other kind."""
    section = config.amplifier if kind == "amplifier" else config.encoder
    driver: Driver = load_driver(section.driver)
    if driver.kind != kind:
        raise BadInput(f"{kind}.driver", f"{section.driver} ({driver.kind})", f"a driver of kind {kind}")
    setup: Setup = driver.setup(config)
    return setup


def checked_load(config: AxisConfig, plans: list[NodePlan]) -> BusLoad:
    """The load that these plans make; raises BadInput with all figures when it exceeds `bus.max_load`."""
    load = bus_load(config, plans)
    check_bus_load(load, config.bus.max_load)
    return load


def planned_bus_load(config: AxisConfig, source: str) -> BusLoad:
    """The load that the configuration in the file `source` makes, computed without a bus.

    Raises BadInput, which names the file, for all that the bring-up would refuse before it asks the nodes.
    """
    try:
        return checked_load(config, [load_setup(config, kind).plan() for kind in ("amplifier", "encoder")])
    except BadInput as error:
        raise BadInput(f"{source}: {error.where}", error.found, error.allowed) from None
