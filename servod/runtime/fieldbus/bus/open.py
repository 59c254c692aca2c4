"""Opens the bus that the configuration names; the only place that knows which class stands behind which interface.

The classes are named as text and imported on demand: the loop on SocketCAN loads neither python-can nor the virtual
world. An interface that is not in the table is one of python-can's.
"""

from __future__ import annotations

from importlib import import_module

from servod.formats.config_wire import BusConfig
from servod.runtime.fieldbus.bus import Bus

#: interface -> (module, class with `configured(BusConfig, can_ids)`).
BUSES: dict[str, tuple[str, str]] = {
    "socketcan": ("servod.runtime.fieldbus.bus.socketcan", "SocketCanBus"),
    "virtual": ("servod.drivers.virtual.client", "VirtualBus"),
}
_OTHERS = ("servod.runtime.fieldbus.bus.python_can", "PythonCanBus")


def open_bus(config: BusConfig, can_ids: tuple[int, ...] | None = None) -> Bus:
    """A new connection to the bus; `can_ids` limits reception where the bus can filter (SocketCAN, virtual).

    Raises Unreachable when the interface, the hub's socket or python-can's driver is not there.
    """
    module, name = BUSES.get(config.interface, _OTHERS)
    bus: Bus = getattr(import_module(module), name).configured(config, can_ids)
    return bus
