"""`servoctl enable` and `servoctl disable`: switch the axis on and off, each only on explicit request."""

from __future__ import annotations

from typing import Annotated

import typer

from servod.cli.common import DEFAULT_SOCKET, JsonOption, SocketOption, ask, example, report

_ENABLE_HELP = example(
    "Enable the axis and wait until it is; holds where it stands.",
    "servoctl enable",
    "servoctl enable --reset-fault",
)
_DISABLE_HELP = example("Bring the axis to rest, ramp the torque down and switch the drive off.", "servoctl disable")


def register(app: typer.Typer) -> None:
    """Add both verbs to `app`."""
    app.command("enable", help=_ENABLE_HELP)(enable)
    app.command("disable", help=_DISABLE_HELP)(disable)


def enable(
    reset_fault: Annotated[
        bool, typer.Option("--reset-fault", help="Reset latched faults and the drive's own.")
    ] = False,
    socket: SocketOption = DEFAULT_SOCKET,
    as_json: JsonOption = False,
) -> None:
    """Enable the axis."""
    report(ask(socket, "enable", reset_fault=reset_fault), "enabled", as_json)


def disable(socket: SocketOption = DEFAULT_SOCKET, as_json: JsonOption = False) -> None:
    """Disable the axis."""
    report(ask(socket, "disable"), "disabled", as_json)
