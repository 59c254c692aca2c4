"""`servoctl deploy`: try a certified gain set on the axis, and keep it only when it proves itself there."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from servod.cli.common import (
    DEFAULT_SOCKET,
    JsonOption,
    SocketOption,
    connect,
    example,
    one_thread,
    print_json,
    progress,
    suggest,
    table_console,
)
from servod.common.errors import AnswerIsNo, BadInput

if TYPE_CHECKING:
    from servod.client.axis import AxisClient
    from servod.formats.config import AxisConfig
    from servod.formats.gains.gain_set import GainSet

_HELP = example(
    "Run a validation motion under the present set and under GAINS, and keep GAINS only when it is no worse and does "
    "what its certificate promised; else, and on Ctrl-C, the present set stays. A set that runs already is held "
    "to its promise alone, and runs on. Travel and speed go with the speed that GAINS was designed for: 20 mrad to "
    "each side at 0.25 rad/s for a design for 0.5 rad/s, 14 s each. What it will be is said before anything moves.",
    "servoctl deploy gains.yaml",
    "servoctl deploy gains.yaml --plant joint.yaml --present old.yaml",
)


def register(app: typer.Typer) -> None:
    """Add the verb to `app`."""
    app.command("deploy", help=_HELP)(deploy)


def deploy(
    gains: Annotated[Path, typer.Argument(help="Gain set with a certificate, YAML.")],
    plant: Annotated[Path | None, typer.Option(help="Start a virtual axis with this joint, SYNC-stepped.")] = None,
    present: Annotated[Path | None, typer.Option(help="Virtual axis: the set that runs before.")] = None,
    config: Annotated[Path | None, typer.Option(help="Virtual axis: its configuration.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Virtual axis: seed of its noise.")] = 1,
    socket: SocketOption = DEFAULT_SOCKET,
    as_json: JsonOption = False,
) -> None:
    """Deploy GAINS; exit code 1 when the axis was rolled back, or when GAINS ran already and broke its promise."""
    one_thread()
    from servod.formats.gains.gain_set import load_gains, require_certificate
    from servod.lab.deploy.deployment import check_admissible, deploy, motion_notice

    wanted = load_gains(gains)
    if present is not None and plant is None:
        raise BadInput("--present", str(present), "only with --plant: a daemon knows what runs")
    require_certificate(wanted, accept_uncertified=None, where=str(gains))
    opened = _on_daemon(socket) if plant is None else _virtual(plant, present, config, wanted, seed)
    with opened as axis, progress("deploy", quiet=as_json) as on_progress:
        check_admissible(wanted, axis.config, str(gains))
        if not as_json:
            print(f"{wanted.name}: {motion_notice(wanted)}", file=sys.stderr, flush=True)
        done = deploy(axis, wanted, on_progress)
    if as_json:
        print_json(done.document())
    else:
        _print(done.document())
    if not done.proven:
        raise AnswerIsNo(done.said)
    if plant is not None:
        suggest("gains", "show", str(gains), why="the virtual axis has ended")
    if not as_json:
        print(done.said)


@contextmanager
def _on_daemon(socket: Path) -> Iterator[AxisClient]:
    from servod.client.processes import sigterm_as_interrupt
    from servod.client.under_daemon import DaemonAxis

    with connect(socket) as client, sigterm_as_interrupt():
        yield DaemonAxis(client)


@contextmanager
def _virtual(
    plant: Path, present: Path | None, config: Path | None, wanted: GainSet, seed: int
) -> Iterator[AxisClient]:
    from servod.client.virtual import axis_for_set
    from servod.formats.config import load_config
    from servod.formats.gains.gain_set import load_gains
    from servod.formats.model.axis_model import load_axis_model

    joint = load_axis_model(plant)
    chosen: AxisConfig | None = load_config(config) if config is not None else None
    before = load_gains(present) if present is not None else None
    with tempfile.TemporaryDirectory(prefix="servod-deploy-") as folder:
        yield axis_for_set(joint, Path(folder), wanted, before, seed, chosen)


def _print(document: dict[str, Any]) -> None:
    from rich.table import Table

    table = Table("Figure", "Before", "After", "Promised", title="Validation motion, mrad")
    for name in document["promised"]:
        runs = (document[run] for run in ("before", "after", "promised"))
        table.add_row(name.removesuffix("_mrad"), *(f"{run[name]:.4g}" if run else "none" for run in runs))
    table_console().print(table)
