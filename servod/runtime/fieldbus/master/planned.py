"""What a configuration plans, without a bus: the drivers' set-up faces, their PDOs, and the load that these will make.

Off the control path. `servod --check` and `servoctl config check` refuse by it what the bring-up would refuse later.
"""

from __future__ import annotations

import grp
import os
from typing import Literal

from servod.common.errors import BadInput
from servod.drivers import driver_table, drivers_of, load_driver
from servod.formats.config import AxisConfig
from servod.runtime.fieldbus.devices import Driver, NodePlan, Setup
from servod.runtime.fieldbus.master.load import BusLoad, bus_load, check_bus_load

#: What a Unix socket's path may be long (sockaddr_un.sun_path with its end, unix(7)).
SOCKET_PATH_BYTES = 107
_OWN_INTERFACES = ("socketcan", "virtual")

Kind = Literal["amplifier", "encoder"]


def load_setup(config: AxisConfig, kind: Kind) -> Setup:
    """The set-up face of the configured amplifier or encoder; raises BadInput unless it is a driver of that kind."""
    name = (config.amplifier if kind == "amplifier" else config.encoder).driver
    driver: Driver | None = load_driver(name) if name in driver_table() else None
    if driver is None or driver.kind != kind:
        found = f"{name} ({driver.kind})" if driver else name
        raise BadInput(f"{kind}.driver", found, ", ".join(drivers_of(kind)))
    setup: Setup = driver.setup(config)
    return setup


def check_names(config: AxisConfig, source: str) -> list[str]:
    """Check what the configuration in the file `source` calls by name and no file stands for; gives notes for people.

    Raises BadInput for a bus interface that nobody knows and for a socket whose path the kernel does not take. A
    control group that is missing is a note: the machine that checks need not be the one that runs.
    """
    _check_interface(config.bus.interface, source)
    paths = {"control.socket": str(config.control.socket)}
    if config.bus.interface == "virtual":
        paths["bus.channel"] = config.bus.channel
    for key, path in paths.items():
        length = len(os.fsencode(path))
        if length > SOCKET_PATH_BYTES:
            raise BadInput(f"{source}: {key}", f"{path} ({length} bytes)", f"at most {SOCKET_PATH_BYTES} bytes")
    try:
        grp.getgrnam(config.control.group)
    except KeyError:
        return [
            f"this machine has no group {config.control.group} (control.group): only root and the daemon's user command"
        ]
    return []


def _check_interface(interface: str, source: str) -> None:
    if interface in _OWN_INTERFACES:
        return
    from can import VALID_INTERFACES

    if interface not in VALID_INTERFACES:
        names = ", ".join(sorted({*_OWN_INTERFACES, *VALID_INTERFACES}))
        raise BadInput(f"{source}: bus.interface", interface, names)


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
