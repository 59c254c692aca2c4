"""`servoctl qualify paper`: the paper's figures and numbers from this software on the virtual axis, and what agrees."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from servod.cli.common import JsonOption, example, need_folder, one_thread, print_json

_HELP = example(
    "Reproduce the paper on the virtual axis: identify Table I's joint and an asymmetric one, track trajectory (19) "
    "and steps under every controller over the whole CAN loop, sweep what the paper leaves open, and write figures, a "
    "page and the paper's numbers beside ours. Takes some minutes; --quick, without identification, a fraction of one.",
    "servoctl qualify paper --out out/paper",
    "servoctl qualify paper --out out/paper --quick --json",
)


def register(app: typer.Typer) -> None:
    """Add the verb to `app`."""
    app.command("paper", help=_HELP, short_help="The paper's figures and numbers on the virtual axis.")(paper)


def paper(
    out: Annotated[Path, typer.Option(help="Folder for paper.html, paper.md, paper.json and pictures.")],
    quick: Annotated[
        bool, typer.Option("--quick", help="Table I's joint alone, as it is told, short runs, no pictures.")
    ] = False,
    seed: Annotated[int, typer.Option(min=0, help="Seed of noise and excitations; the same gives the same.")] = 1,
    as_json: JsonOption = False,
) -> None:
    """Do the paper into OUT."""
    one_thread()
    from dataclasses import replace

    from servod.cli.common import progress
    from servod.qualify.paper.walk import QUICK, PaperPlan
    from servod.qualify.paper.walk import paper as run

    need_folder("--out", out)
    plan = replace(QUICK if quick else PaperPlan(), seed=seed)
    with progress("paper", quiet=as_json) as tell:
        document = run(plan, out, tell)
    if as_json:
        print_json(document)
    else:
        print_document(document, out)


def print_document(document: dict[str, Any], out: Path) -> None:
    """Print the table of numbers, and how many statements of the paper hold here."""
    from servod.qualify.paper.table import numbers

    table = numbers(document)
    widths = [max(len(line[i]) for line in (table.header, *table.rows)) for i in range(len(table.header))]
    for line in (table.header, *table.rows):
        print("  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip())
    claims = [claim for figure in document["figures"] for claim in figure["claims"]] + document["statements"]
    agree = sum(claim["agrees"] for claim in claims)
    print(f"{agree} of {len(claims)} statements of the paper hold here; {document['elapsed_s']:.0f} s.")
    print(f"Page: {out / 'paper.html'}; table and statements: {out / 'paper.md'}; pictures: {out / 'pictures'}")
