"""`servoctl prove`: a blind trial of `servoctl diagnose` on axes that conceal something.

Works on files alone; needs the lab extra.
"""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from servod.cli.common import example, need_folder, one_thread

_HELP = example(
    "Prove the diagnosis on concealed cases: draw axes, hide physics in them, record them, and see what is named.",
    "servoctl prove --cases 120 --seed 7 --out out/prove",
)


class Stage(StrEnum):
    """What `--only` may ask for."""

    CASES = "cases"


def register(app: typer.Typer) -> None:
    """Add the verb to `app`."""
    app.command(name="prove", help=_HELP)(prove)


def prove(
    out: Annotated[Path, typer.Option(help="Folder of the trial.")],
    cases: Annotated[int, typer.Option(min=1, max=10_000, help="How many cases.")] = 120,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the trial; the same draws the same cases.")] = 1,
    harder: Annotated[
        bool, typer.Option("--harder", help="1 % of other effects, four times the noise, other forms in the plant.")
    ] = False,
    only: Annotated[Stage | None, typer.Option(help="`cases`: write open cases, truth and all, into OUT.")] = None,
) -> None:
    """Run the trial in OUT."""
    one_thread()
    from servod.cli.progress import progress
    from servod.prove.conceal import open_cases
    from servod.prove.plan import HARDER, Settings, plans

    need_folder("--out", out)
    settings = HARDER if harder else Settings()
    with progress("cases", quiet=False) as tell:
        open_cases(plans(cases, seed, settings), settings, out, lambda n, of: tell(f"case {n} of {of}", n / of))
