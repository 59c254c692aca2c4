"""`servoctl scan`: which nodes are on the bus, asked through the daemon or, where none runs, on the bus itself."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from servod.cli.common import DEFAULT_SOCKET, JsonOption, SocketOption, ask, example, print_json, table_console
from servod.cli.groups import bus_interfaces
from servod.common.errors import BadInput, Unreachable, one_line
from servod.common.portable import need_linux

if TYPE_CHECKING:
    from servod.formats.config_wire import BusConfig

_HELP = example(
    "List the nodes on the bus with identity, NMT state and LSS. Without --channel the daemon is asked; with it the "
    "bus is opened directly, unless a daemon owns it: then that is asked too.",
    "servoctl scan",
    "servoctl scan --interface socketcan --channel can0",
)


_PROFILE_MASK = 0xFFFF  # low word of 0x1000


def register(app: typer.Typer) -> None:
    """Add the verb to `app`."""
    app.command("scan", help=_HELP)(scan)


def scan(
    interface: Annotated[
        str | None,
        typer.Option(
            help="virtual, socketcan (with --channel the default), or a name that python-can knows.",
            autocompletion=bus_interfaces,
        ),
    ] = None,
    channel: Annotated[str | None, typer.Option(help="Interface name, or the virtual bus's socket.")] = None,
    bit_rate: Annotated[int, typer.Option(help="Bit rate, for buses that python-can opens.")] = 1_000_000,
    socket: SocketOption = DEFAULT_SOCKET,
    as_json: JsonOption = False,
) -> None:
    """Scan the bus."""
    if interface is not None:
        from servod.runtime.fieldbus.master.planned import check_interface

        check_interface(interface, "--interface")
    if interface is not None and channel is None:
        raise BadInput(f"--interface {interface}", "no --channel", "--channel with the interface's name or socket too")
    nodes = _through_daemon(socket) if channel is None else _on_bus(interface or "socketcan", channel, bit_rate, socket)
    if as_json:
        print_json({"nodes": nodes})
    else:
        _print(nodes)


def _through_daemon(socket: Any) -> list[dict[str, Any]]:
    nodes: list[dict[str, Any]] = ask(socket, "scan")["nodes"]
    return nodes


def _on_bus(interface: str, channel: str, bit_rate: int, socket: Any) -> list[dict[str, Any]]:
    need_linux("servoctl scan")
    from servod.common.yaml import validate
    from servod.formats.config_wire import BusConfig
    from servod.runtime.daemon.lock import BusLock

    config = validate({"interface": interface, "channel": channel, "bit_rate": bit_rate}, BusConfig, "servoctl scan")
    try:
        lock = BusLock(config)
    except Unreachable as owned:
        return _through_owner(socket, config, owned)
    with lock:
        return _scan_bus(config)


def _scan_bus(config: BusConfig) -> list[dict[str, Any]]:
    from dataclasses import asdict

    from servod.common.clock import WallClock
    from servod.runtime.fieldbus.bus.open import open_bus
    from servod.runtime.fieldbus.master.scan import scan as scan_bus

    nodes = scan_bus(open_bus(config), WallClock())  # closes the bus
    return [asdict(node) | {"lss": node.lss and node.lss._asdict()} for node in nodes]


def _through_owner(socket: Any, config: BusConfig, owned: Unreachable) -> list[dict[str, Any]]:
    """Ask the daemon at `socket` if it is the one that owns the bus; raises `owned`, with what to do, otherwise."""
    try:
        bus = ask(socket, "status")["bus"]
    except Unreachable:
        bus = {}
    if (bus.get("interface"), bus.get("channel")) != (config.interface, config.channel):
        raise Unreachable(f"{owned}; ask it: servoctl scan --socket SOCKET")
    return _through_daemon(socket)


def _print(nodes: list[dict[str, Any]]) -> None:
    from rich.table import Table

    if not nodes:
        print("no node answered")
        return
    table = Table("Node", "Profile", "Vendor", "Product", "Revision", "Serial", "Name")
    for node in nodes:
        table.add_row(*_cells(node))
    table_console(markup=False).print(table)  # names are the devices' own words


def _cells(node: dict[str, Any]) -> list[str]:
    """One row; a node without an id was found by LSS, which gives its identity alone."""
    identity = node["identity"] or node["lss"] or {}
    profile = identity.get("device_type", 0) & _PROFILE_MASK
    return [
        "none yet (LSS)" if node["node_id"] is None else str(node["node_id"]),
        f"CiA {profile}" if profile else "-",
        *(_hex(identity.get(key)) for key in ("vendor_id", "product_code", "revision")),
        "-" if identity.get("serial") is None else str(identity["serial"]),
        one_line(node["name"]),
    ]


def _hex(value: int | None) -> str:
    return "-" if value is None else f"0x{value:X}"
