"""`servoctl stop`: the drive's quick stop, at once."""

from __future__ import annotations

import typer

from servod.cli.common import DEFAULT_SOCKET, JsonOption, SocketOption, ask_to_stop, example, report

_HELP = example("Quick stop: the drive stops the axis by its own option (0x605A) and switches off.", "servoctl stop")


def register(app: typer.Typer) -> None:
    """Add the verb to `app`."""
    app.command("stop", help=_HELP)(stop)


def stop(socket: SocketOption = DEFAULT_SOCKET, as_json: JsonOption = False) -> None:
    """Stop the axis."""
    report(ask_to_stop(socket, "stop"), "stopped", as_json)
