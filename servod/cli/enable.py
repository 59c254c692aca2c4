"""`servoctl enable`, `disable` and `stop`: switch the axis on and off, each only on explicit request."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from servod.cli.common import DEFAULT_SOCKET, JsonOption, SocketOption, ask_to_stop, connect, example, report

_ENABLE_HELP = example(
    "Enable the axis and wait until it is; holds where it stands. The first time after a start, polarity, scale and "
    "directions are proven by a test of small torque and travel before.",
    "servoctl enable",
    "servoctl enable --reset-fault",
    "servoctl enable --prove",
)
_DISABLE_HELP = example("Bring the axis to rest, ramp the torque down and switch the drive off.", "servoctl disable")
_STOP_HELP = example(
    "Quick stop: the drive stops the axis by its own option (0x605A) and switches off.", "servoctl stop"
)


def register(app: typer.Typer) -> None:
    """Add the verbs to `app`."""
    app.command("enable", help=_ENABLE_HELP)(enable)
    app.command("disable", help=_DISABLE_HELP)(disable)
    app.command("stop", help=_STOP_HELP)(stop)


def enable(
    reset_fault: Annotated[
        bool, typer.Option("--reset-fault", help="Reset latched faults and the drive's own.")
    ] = False,
    prove: Annotated[
        bool, typer.Option("--prove", help="Repeat the test of the wiring, although it was passed.")
    ] = False,
    socket: SocketOption = DEFAULT_SOCKET,
    as_json: JsonOption = False,
) -> None:
    """Enable the axis."""
    from servod.formats.stopping import UNKNOWN

    result, joint_known = _enable_or_leave_off(socket, reset_fault=reset_fault, prove=prove)
    wiring = result.get("wiring")
    lines = ["enabled", *([wiring["text"]] if wiring else []), *([] if joint_known else [f"warning: {UNKNOWN}"])]
    report(result, "\n".join(lines), as_json)


def _enable_or_leave_off(socket: Path, **arguments: bool) -> tuple[dict[str, Any], bool]:
    """Enable and wait; whatever interrupts it has the axis off before it ends the command. Also whether anything tells
    of the joint, so that its stop is reckoned."""
    from servod.client.processes import sigterm_as_interrupt

    with connect(socket) as client, sigterm_as_interrupt():
        try:
            result: dict[str, Any] = client.call("enable", **arguments)
            known = client.call("status")["stopping"] is not None
        except KeyboardInterrupt:
            client.call("disable")
            raise
    return result, known


def disable(socket: SocketOption = DEFAULT_SOCKET, as_json: JsonOption = False) -> None:
    """Disable the axis."""
    report(ask_to_stop(socket, "disable"), "disabled", as_json)


def stop(socket: SocketOption = DEFAULT_SOCKET, as_json: JsonOption = False) -> None:
    """Stop the axis by the drive's quick stop, at once."""
    report(ask_to_stop(socket, "stop"), "stopped", as_json)
