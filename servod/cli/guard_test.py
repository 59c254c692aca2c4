"""`servoctl guard-test`: the master falls silent on purpose, and looks that the drive stops by itself in time."""

from __future__ import annotations

import signal
import sys
from pathlib import Path
from typing import Annotated

import typer

from servod.cli.common import JsonOption, example, report
from servod.common.portable import need_linux

_ENDS = (signal.SIGINT, signal.SIGTERM, getattr(signal, "SIGHUP", signal.SIGTERM))
_HELP = example(
    "Prove that the drive stops by itself when servod is dead. It is enabled at zero torque with the joint at rest, "
    "then the commands stay away, then the heartbeat, then everything and SYNC too; each time the drive must stop "
    "within its time. Only while no daemon runs the axis, with a hanging load held and nobody in reach.",
    "servoctl guard-test /etc/servod/axis.yaml",
)


def register(app: typer.Typer) -> None:
    """Add the verb to `app`."""
    app.command("guard-test", help=_HELP)(guard_test)


def _end(signum: int, _frame: object) -> None:
    """Once: a second signal would break off the switching off."""
    for number in _ENDS:
        signal.signal(number, signal.SIG_IGN)
    if signum == signal.SIGINT:
        raise KeyboardInterrupt
    sys.exit(128 + signum)


def guard_test(
    config: Annotated[Path, typer.Argument(help="Configuration of the axis.")], as_json: JsonOption = False
) -> None:
    """Try the drive's guards."""
    need_linux("servoctl guard-test")
    from dataclasses import asdict

    from servod.common.clock import WallClock
    from servod.common.errors import AnswerIsNo
    from servod.formats.config import load_config
    from servod.runtime.daemon.guard_test import GuardTest, keep_proof
    from servod.runtime.daemon.lock import InstanceLock
    from servod.runtime.fieldbus.bus.open import open_bus
    from servod.runtime.fieldbus.master.planned import check_interface

    axis = load_config(config)
    check_interface(axis.bus.interface, f"{config}: bus.interface")
    for number in _ENDS:  # as Ctrl-C: the drive is switched off before this ends
        signal.signal(number, _end)
    with InstanceLock(axis, passing=True):
        test = GuardTest(axis, lambda: open_bus(axis.bus), WallClock(), lambda text: typer.echo(text, err=True))
        results, found = test.run()
    words = [
        f"{result.guard}: stopped within {result.left_ms:.1f} ms of the last frame, off after {result.off_ms:.0f} ms "
        f"(limit {result.limit_ms:.1f} ms)"
        if result.left_ms is not None and result.off_ms is not None
        else f"{result.guard}: the drive went on"
        if result.left_ms is None
        else f"{result.guard}: the drive left the command after {result.left_ms:.1f} ms and did not stay without power"
        for result in results
    ]
    if not all(result.passed for result in results):
        raise AnswerIsNo(
            f"the drive does not guard itself ({'; '.join(words)}): see amplifier.quirks and the drive's manual for "
            "0x6007 and 0x1400:5; where only the heartbeat stops it, heartbeat.command_deadline_ms: 0"
        )
    path = keep_proof(axis, results, found)
    document = {"results": [asdict(result) for result in results], "proof": str(path)}
    report(document, "\n".join([*words, f"proof in {path}"]), as_json)
