"""The drivers, by name: one lazy table, extended by the entry-point group `servod.drivers`.

A driver is `servod.runtime.fieldbus.devices.Driver`: a set-up face that runs in the supervisor and a cycle face that
runs in the loop. The table names modules as text, so that listing them imports nothing.
"""

from __future__ import annotations

from contextlib import suppress
from importlib import import_module
from importlib.metadata import entry_points
from typing import cast

from servod.common.errors import BadInput
from servod.runtime.fieldbus.devices import Amplifier, Driver, Encoder, NodePlan

#: name -> "module:attribute" of a servod.runtime.fieldbus.devices.Driver.
DRIVERS: dict[str, str] = {
    "cia402": "servod.drivers.cia402:DRIVER",
    "cia406": "servod.drivers.cia406:DRIVER",
}
ENTRY_POINT_GROUP = "servod.drivers"


def driver_table() -> dict[str, str]:
    """All known drivers: the table above and the installed entry points; the table wins where names collide."""
    installed = {point.name: point.value for point in entry_points(group=ENTRY_POINT_GROUP)}
    return installed | DRIVERS


def drivers_of(kind: str) -> list[str]:
    """The names of the drivers of that kind ("amplifier" or "encoder"); those that cannot be loaded are left out."""
    found = []
    for name in sorted(driver_table()):
        with suppress(BadInput):
            if load_driver(name).kind == kind:
                found.append(name)
    return found


def load_driver(name: str) -> Driver:
    """The driver of that name; raises BadInput with the known names when there is none or it cannot be loaded."""
    entry_point = DRIVERS.get(name) or driver_table().get(name)  # ours win: no need to search the installed packages
    if entry_point is None:
        raise BadInput("driver", name, ", ".join(sorted(driver_table())))
    module_name, _, attribute = entry_point.partition(":")
    try:
        driver = getattr(import_module(module_name), attribute)
    except (ImportError, AttributeError) as error:
        raise BadInput(f"driver {name}", f"{entry_point} ({error})", "an importable module:attribute") from error
    if not isinstance(driver, Driver):
        raise BadInput(f"driver {name}", type(driver).__name__, "a servod.runtime.fieldbus.devices.Driver")
    return driver


def amplifier_of(plan: NodePlan) -> Amplifier:
    """The cycle face of the amplifier that a node's plan names. Raises BadInput."""
    return cast(Amplifier, _cyclic(plan, "amplifier"))


def encoder_of(plan: NodePlan) -> Encoder:
    """The cycle face of the encoder that a node's plan names. Raises BadInput."""
    return cast(Encoder, _cyclic(plan, "encoder"))


def _cyclic(plan: NodePlan, kind: str) -> Amplifier | Encoder:
    driver = load_driver(plan.driver)
    if driver.kind != kind:
        raise BadInput(f"driver {plan.driver}", f"a driver of an {driver.kind}", f"one of an {kind}")
    return driver.cyclic(plan)
