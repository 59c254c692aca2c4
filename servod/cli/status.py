"""`servoctl status`: state, goal, reasons and health of the axis in one screen.

What tells nothing of now is grey and says its age: feedback and heartbeats that stay away, a loop that writes no cycle,
a daemon that sends no status.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import TYPE_CHECKING, Annotated, Any

import typer

from servod.cli.common import DEFAULT_SOCKET, SocketOption, connect, example, print_json, suggest, table_console
from servod.common.errors import one_line

if TYPE_CHECKING:
    from rich.console import Group, RenderableType
    from rich.table import Table

#: A daemon that sends five times a second is silent after this time.
_SILENT_S = 1.0
_HELP = example(
    "Show state, goal, reasons and health of the axis in one screen.",
    "servoctl status",
    "servoctl status --watch",
    "servoctl status --json",
    "servoctl status --watch --json",
)


def register(app: typer.Typer) -> None:
    """Add the verb to `app`."""
    app.command("status", help=_HELP)(status)


def status(
    watch: Annotated[bool, typer.Option("--watch", help="Keep showing until Ctrl-C.")] = False,
    socket: SocketOption = DEFAULT_SOCKET,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON document and nothing else; with --watch one for each line.")
    ] = False,
) -> None:
    """Show the status."""
    with connect(socket) as client:
        if watch:
            with suppress(KeyboardInterrupt):
                (_print_lines if as_json else follow)(client.watch())
            return
        document = client.call("status")
    if as_json:
        print_json(document)
        return
    _suggest(document["axis"])
    table_console().print(screen(document))


def _suggest(axis: dict[str, Any]) -> None:
    """By the state of the axis."""
    if axis["state"] == "FAULT":
        suggest("faults", why="the first cause, and what to do")
    elif axis["motion_running"]:
        suggest("status", "--watch")
    elif axis["state"] == "ENABLED":
        suggest("track", "sine", "--amplitude", "0.02", "--frequency", "0.2", "--duration", "10")


def _print_lines(documents: Iterator[dict[str, Any]]) -> None:
    """JSON Lines; each is complete when it goes out, also into a pipe."""
    for document in documents:
        print(json.dumps(document, allow_nan=False), flush=True)


def follow(documents: Iterator[dict[str, Any]]) -> None:
    """Show each status as it comes: on a terminal in the place of the one before."""
    from rich.live import Live

    view, console = WatchView(), table_console()
    if not console.is_terminal:  # into a pipe or a file nothing is drawn again: each status as it comes
        for document in documents:
            console.print(screen(document))
            console.file.flush()
        return
    with Live(view, refresh_per_second=5):
        for document in documents:
            view.see(document)


class WatchView:
    """The newest status on the screen; it grows old there when the next one does not come."""

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s, self._heard_s = now_s, 0.0
        self._document: dict[str, Any] | None = None

    def see(self, document: dict[str, Any]) -> None:
        """A status came."""
        self._document, self._heard_s = document, self._now_s()

    def __rich__(self) -> RenderableType:
        """Called by rich at every refresh."""
        from rich.console import Group
        from rich.styled import Styled

        if self._document is None:
            return ""
        silent_s = self._now_s() - self._heard_s
        if silent_s <= _SILENT_S:
            return screen(self._document)
        text = f"[red]no status from the daemon for {silent_s:.1f} s; everything below is old[/red]"
        return Group(text, Styled(screen(_older(self._document, silent_s)), "dim"))


def _older(value: Any, by_s: float) -> Any:
    """The document when it has grown old by so much: all of it is stale."""
    if isinstance(value, list):
        return [_older(inner, by_s) for inner in value]
    if not isinstance(value, dict):
        return value
    older = {key: _older(inner, by_s) for key, inner in value.items()}
    if "stale" in older:
        older["stale"] = True
        older["age_s"] = None if value["age_s"] is None else value["age_s"] + by_s
    return older


def screen(document: dict[str, Any]) -> Group:
    """The status document (servod.runtime.daemon.status.Status) as one screen."""
    from rich.console import Group

    document = _plain(document)
    return Group(
        _headline(document),
        *_fault_lines(document),
        *_note_lines(document),
        *_wiring_lines(document),
        *_stopping_lines(document),
        *_guard_lines(document),
        *_promise_lines(document),
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
    state = _aged(f"is [bold]{axis['state']}[/bold], goal {axis['goal']} {reached}{why}", document["loop"])
    words = f"(status word {drive['status_word']}, error {drive['error_code']}, mode {drive['mode']})"
    return f"[bold]{document['name']}[/bold] {state}\n" + _aged(f"drive {drive['state']} {words}", drive)


def _aged(text: str, age: dict[str, Any]) -> str:
    """The text; grey and with its age where it tells nothing of now."""
    if not age["stale"]:
        return text
    since = "never heard" if age["age_s"] is None else f"stale {age['age_s']:.1f} s"
    return f"[dim]{', '.join(filter(None, (text, since)))}[/dim]"


def _heard(age: dict[str, Any]) -> str:
    """When it was heard last."""
    return _aged("" if age["stale"] else f"heard {age['age_s']:.3f} s ago", age)


def _fault_lines(document: dict[str, Any]) -> list[str]:
    return [
        f"[red]{'now' if f['present'] else 'was'}[/red] {f['code']} ({f['reaction']}): {f['cause']} {f['remedy']}"
        for f in document["faults"]
    ]


def _note_lines(document: dict[str, Any]) -> list[str]:
    note, abandoned = document["controller"]["note"], document["motion"].get("abandoned", "")
    lines = [f"[yellow]gain set[/yellow] {note}"] if note else []
    return [*lines, *([f"[yellow]halted[/yellow] {abandoned}"] if abandoned else [])]


def _wiring_lines(document: dict[str, Any]) -> list[str]:
    last = document["wiring"]["last"]
    if last is None:
        return []
    return [last["text"] if last["passed"] else f"[red]{last['text']}[/red]"]


def _stopping_lines(document: dict[str, Any]) -> list[str]:
    """The stop that is stated, and what was narrowed for it."""
    stop = document["stopping"]
    if stop is None:
        return ["[yellow]stopping[/yellow] not computed: the joint is not stated (see `servoctl config check`)"]
    coasts = "does not rest" if stop["coasts_rad"] is None else f"coasts {stop['coasts_rad']:.3g} rad at most"
    line = (
        f"stops within {1e3 * stop['time_s']:.0f} ms, {stop['speed_rad_s']:.3g} rad/s and {stop['travel_rad']:.3g} rad "
        f"after a loss of the master; without the drive it {coasts}"
    )
    return ["; ".join([line, *(f"[yellow]narrowed[/yellow] {text}" for text in stop["narrowed"])])]


def _promise_lines(document: dict[str, Any]) -> list[str]:
    """What of the joint is not as the running set's certificate has it; nothing where all is."""
    deviations = [
        f"{row['name']} {row['share']:.2f} times the model's, certified from {row['certified'][0]:.2f} to "
        f"{row['certified'][1]:.2f}"
        for row in document["promise"]["joint"]
        if row["told"]
    ]
    deviations += [
        f"RMS error {1e3 * row['rms_rad']:.3g} mrad in {row['kind']} motion, promised {1e3 * row['promised_rad']:.3g}"
        for row in document["promise"]["errors"]
        if row["told"]
    ]
    return [f"[yellow]not as certified[/yellow] {'; '.join(deviations)}"] if deviations else []


def _guard_lines(document: dict[str, Any]) -> list[str]:
    guards = document["guards"]
    proof = guards["proof"]
    lines = ["[red]unguarded[/red] the drive does not stop by itself when servod is dead"] * guards["unguarded"]
    return lines + [f"[yellow]guards[/yellow] {proof['text']}"] * (proof["asked_for"] and not proof["holds"])


def _values(document: dict[str, Any]) -> Table:
    """Position, velocity and error are as old as the encoder's feedback, and so is a reference that only follows the
    joint; what the loop makes is as old as its cycle."""
    from rich.table import Table

    motion, controller, bus, loop = (document[k] for k in ("motion", "controller", "bus", "loop"))
    enabled = document["axis"]["state"] == "ENABLED"
    table = Table(show_header=False, box=None, padding=(0, 2, 0, 0))

    def measured(label: str, key: str, scale: float, unit: str) -> tuple[str, str]:
        return label, _aged(_number(motion[key], scale, unit), motion)

    def made(label: str, key: str, scale: float, unit: str) -> tuple[str, str]:
        return label, _aged(_number(motion[key], scale, unit), loop)

    table.add_row(
        *measured("position", "position_rad", 1.0, "rad"),
        *(made if enabled else measured)("reference", "reference_rad", 1.0, "rad"),
    )
    table.add_row(
        *measured("error", "following_error_rad", 1e3, "mrad"), *measured("velocity", "velocity_rad_s", 1.0, "rad/s")
    )
    table.add_row(*made("torque", "torque_nm", 1.0, "N·m"), *made("of it friction", "torque_friction_nm", 1.0, "N·m"))
    table.add_row("encoder", _heard(motion), "drive", _heard(document["drive"]))
    law = _aged(f"{controller['name']} ({controller['law']})", loop)
    table.add_row("controller", law, "recording", _recording(document["recorder"]))
    load = f"{bus['load']:.0%} of {bus['max_load']:.0%} allowed"
    table.add_row("bus", f"{bus['interface']} {bus['channel']}", "load", load)
    queue_full, error_frames = (_aged(str(bus[key]), loop) for key in ("queue_full", "error_frames"))
    table.add_row("queue full", queue_full, "error frames", error_frames)
    if inputs := document["inputs"]:
        words = (_input(row["name"], row["active"]) for row in inputs)
        table.add_row("inputs", _aged(", ".join(words), loop))
    if (brake := document["brake"])["by"] != "none":
        table.add_row("brake", _aged(f"{brake['state']}, by {brake['by']}", loop))
    for node in document["nodes"]:
        state = node["state"] if node["stale"] else f"{node['state']}, {_heard(node)}"
        table.add_row(f"node {node['node_id']}", node["role"], node["driver"], _aged(state, node))
    return table


def _input(name: str, active: bool) -> str:
    return f"[red]{name} ACTIVE[/red]" if active else f"{name} clear"


def _timing(document: dict[str, Any]) -> Group:
    """The line above is none of the table's, which would break it to its own width."""
    from rich.console import Group
    from rich.table import Table

    timing, loop = document["timing"], document["loop"]
    title = f"cycle {timing['cycle']}, {timing['missed']} missed; last {timing['window_s']:.0f} s in µs"
    style = "dim" if loop["stale"] else ""
    table = Table("", "median", "p99", "max", box=None, style=style)
    for key, label in (("lag", "wake-up"), ("tick", "work"), ("torque", "deadline to torque")):
        row = timing[key]
        table.add_row(label, *(f"{row[name]:.0f}" for name in ("p50_us", "p99_us", "max_us")), style=style)
    return Group(_aged(title, loop), table)


def _grant_lines(document: dict[str, Any]) -> list[str]:
    refused = [g for g in document["grants"] if not g["granted"]]
    return [f"[yellow]not granted[/yellow] {g['name']}: {g['reason']}" for g in refused]


def _recording(recorder: dict[str, Any]) -> str:
    removed = f"; {recorder['removed']} old files removed" if recorder["removed"] else ""
    if recorder["failure"]:
        return f"failed: {recorder['failure']}{removed}"
    return (f"{recorder['path']} ({recorder['records']} cycles)" if recorder["recording"] else "off") + removed


def _number(value: float | None, scale: float, unit: str) -> str:
    return "not finite" if value is None else f"{value * scale:+.4f} {unit}"
