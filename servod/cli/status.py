"""`servoctl status`: state, goal, reasons and health of the axis in one screen."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from servod.cli.common import DEFAULT_SOCKET, JsonOption, SocketOption, connect, example, print_json
from servod.common.errors import one_line

if TYPE_CHECKING:
    from rich.console import Group
    from rich.table import Table

_HELP = example(
    "Show state, goal, reasons and health of the axis in one screen.",
    "servoctl status",
    "servoctl status --watch",
    "servoctl status --json",
)


def register(app: typer.Typer) -> None:
    """Add the verb to `app`."""
    app.command("status", help=_HELP)(status)


def status(
    watch: Annotated[bool, typer.Option("--watch", help="Keep showing until Ctrl-C.")] = False,
    socket: SocketOption = DEFAULT_SOCKET,
    as_json: JsonOption = False,
) -> None:
    """Show the status."""
    with connect(socket) as client:
        if watch and not as_json:
            _watch(client.watch())
            return
        document = client.call("status")
    if as_json:
        print_json(document)
        return
    from rich.console import Console

    Console().print(screen(document))


def _watch(documents: Any) -> None:
    from rich.live import Live

    with Live(auto_refresh=False) as live:
        try:
            for document in documents:
                live.update(screen(document), refresh=True)
        except KeyboardInterrupt:
            return


def screen(document: dict[str, Any]) -> Group:
    """The status document (servod.runtime.daemon.status.Status) as one screen."""
    from rich.console import Group

    document = _plain(document)
    return Group(
        _headline(document),
        *_fault_lines(document),
        *_wiring_lines(document),
        _values(document),
        _timing(document),
        *_grant_lines(document),
    )


def _plain(value: Any) -> Any:
    """The document with texts that say what they say: no markup of this screen, nothing that acts on a terminal."""
    from rich.markup import escape

    if isinstance(value, dict):
        return {key: _plain(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [_plain(inner) for inner in value]
    return escape(one_line(value)) if isinstance(value, str) else value


def _headline(document: dict[str, Any]) -> str:
    axis, drive = document["axis"], document["drive"]
    reached = "reached" if axis["goal_reached"] else "not reached"
    why = f": {'; '.join(axis['reasons'])}" if axis["reasons"] else ""
    return (
        f"[bold]{document['name']}[/bold] is [bold]{axis['state']}[/bold], goal {axis['goal']} {reached}{why}\n"
        f"drive {drive['state']} (status word {drive['status_word']}, error {drive['error_code']}, "
        f"mode {drive['mode']})"
    )


def _fault_lines(document: dict[str, Any]) -> list[str]:
    return [
        f"[red]{'now' if f['present'] else 'was'}[/red] {f['code']} ({f['reaction']}): {f['cause']} {f['remedy']}"
        for f in document["faults"]
    ]


def _wiring_lines(document: dict[str, Any]) -> list[str]:
    last = document["wiring"]["last"]
    if last is None:
        return []
    return [last["text"] if last["passed"] else f"[red]{last['text']}[/red]"]


def _values(document: dict[str, Any]) -> Table:
    from rich.table import Table

    motion, controller, bus, recorder = (document[k] for k in ("motion", "controller", "bus", "recorder"))
    table = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    table.add_row("position", _rad(motion["position_rad"]), "reference", _rad(motion["reference_rad"]))
    table.add_row(
        "error",
        _number(motion["following_error_rad"], 1e3, "mrad"),
        "velocity",
        _number(motion["velocity_rad_s"], 1.0, "rad/s"),
    )
    table.add_row(
        "torque",
        _number(motion["torque_nm"], 1.0, "N·m"),
        "of it friction",
        _number(motion["torque_friction_nm"], 1.0, "N·m"),
    )
    table.add_row("controller", f"{controller['name']} ({controller['law']})", "recording", _recording(recorder))
    table.add_row(
        "bus", f"{bus['interface']} {bus['channel']}", "load", f"{bus['load']:.0%} of {bus['max_load']:.0%} allowed"
    )
    table.add_row("queue full", str(bus["queue_full"]), "error frames", str(bus["error_frames"]))
    for node in document["nodes"]:
        table.add_row(f"node {node['node_id']}", node["role"], node["driver"], node["state"])
    return table


def _timing(document: dict[str, Any]) -> Table:
    from rich.table import Table

    timing = document["timing"]
    title = f"cycle {timing['cycle']}, {timing['missed']} missed; last {timing['window_s']:.0f} s in µs"
    table = Table("", "median", "p99", "max", title=title, title_justify="left", box=None)
    for key, label in (("lag", "wake-up"), ("tick", "work"), ("torque", "deadline to torque")):
        row = timing[key]
        table.add_row(label, *(f"{row[name]:.0f}" for name in ("p50_us", "p99_us", "max_us")))
    return table


def _grant_lines(document: dict[str, Any]) -> list[str]:
    refused = [g for g in document["grants"] if not g["granted"]]
    return [f"[yellow]not granted[/yellow] {g['name']}: {g['reason']}" for g in refused]


def _recording(recorder: dict[str, Any]) -> str:
    if recorder["failure"]:
        return f"failed: {recorder['failure']}"
    return f"{recorder['path']} ({recorder['records']} cycles)" if recorder["recording"] else "off"


def _rad(value: float | None) -> str:
    return _number(value, 1.0, "rad")


def _number(value: float | None, scale: float, unit: str) -> str:
    return "not finite" if value is None else f"{value * scale:+.4f} {unit}"
