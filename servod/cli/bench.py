"""`servoctl bench`: how well this machine runs the loop, as a table and as JSON."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from servod.cli.common import JsonOption, example, need_folder, print_json, table_console
from servod.common.portable import need_linux

if TYPE_CHECKING:
    from rich.console import Console

_QUIET_S, _ATTACK_S, _STOPS, _ROUNDS = 4.0, 4.0, 5, 2
_HELP = example(
    "Measure wake-up (against cyclictest), cycle work, two processes on the wall clock, stepped and simulated "
    "speed, memory, and how long synthesis, certificate and commissioning take. Takes about 18 minutes, most of it "
    "watching memory; --quick takes about two, without a commissioning. --attack measures wake-up and time to stop "
    "while the control socket is under attack, and nothing else, in half a minute.",
    "servoctl bench",
    "servoctl bench --attack",
    "servoctl bench --quick --json",
)


def register(app: typer.Typer) -> None:
    """Add the verb to `app`."""
    app.command("bench", help=_HELP)(bench)


def bench(
    quick: Annotated[
        bool, typer.Option("--quick", help="Shorter runs; every figure says how long it was measured.")
    ] = False,
    attack: Annotated[bool, typer.Option("--attack", help="Only the control socket under attack.")] = False,
    out: Annotated[Path | None, typer.Option(help="Write the JSON document to this file as well.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Run the benchmark."""
    need_linux("servoctl bench")
    from rich.console import Console

    from servod.qualify.bench import QUICK, THOROUGH, measure
    from servod.qualify.bench.plan import print_table, write_json

    if out is not None:
        need_folder("--out", out.parent)  # said now, not after a quarter of an hour
    console = Console(stderr=True, quiet=as_json)
    if attack:
        _attack(console, out, as_json)
        return
    with console.status("servoctl bench") as line:
        document = measure(QUICK if quick else THOROUGH, lambda text: line.update(f"measuring: {text}"))
    if out is not None:
        write_json(document, out)
    if as_json:
        print_json(document)
    else:
        print_table(document, table_console())


def _attack(console: Console, out: Path | None, as_json: bool) -> None:
    from servod.qualify.bench import attack
    from servod.qualify.bench.plan import write_json

    with console.status("measuring: wake-up and stops, alone and under attack"):
        document = attack.measure(_QUIET_S, _ATTACK_S, _STOPS, _ROUNDS)
    if out is not None:
        write_json(document, out)
    if as_json:
        print_json(document)
    else:
        print(attack.text(document))
