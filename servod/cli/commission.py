"""`servoctl commission`: the whole walk from an unknown axis to a certified, deployed and proven controller."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from servod.cli.common import (
    DEFAULT_SOCKET,
    JsonOption,
    SocketOption,
    example,
    need_folder,
    one_thread,
    print_json,
    progress,
    suggest,
    table_console,
)
from servod.cli.groups import walk_steps
from servod.common.errors import BadInput
from servod.common.progress import OnProgress

if TYPE_CHECKING:
    from servod.client.open import WalkAxis

_HELP = example(
    "Identify the axis, synthesize and verify a gain set for it, deploy it on trial, compare, and report. "
    "Interrupted at any moment, the same command goes on in the same folder. A virtual axis takes about four minutes.",
    "servoctl commission --config /etc/servod/config/can0.yaml --out commissioning",
    "servoctl commission --plant joint.yaml --out commissioning --json",
)


def register(app: typer.Typer) -> None:
    """Add the verb to `app`."""
    app.command("commission", help=_HELP)(commission)


def commission(
    out: Annotated[Path, typer.Option(help="Folder of this commissioning; with an earlier part of it, goes on.")],
    plant: Annotated[Path | None, typer.Option(help="Start a virtual axis with this joint, SYNC-stepped.")] = None,
    config: Annotated[Path | None, typer.Option(help="Axis configuration; needed on a daemon's axis.")] = None,
    settings: Annotated[Path | None, typer.Option(help="Virtual axis: what drive and encoder really are.")] = None,
    encoder_counts: Annotated[int | None, typer.Option(min=4, help="Virtual axis: counts per turn.")] = None,
    travel: Annotated[float | None, typer.Option(min=0.02, help="Travel to each side at most, rad.")] = None,
    speed: Annotated[float | None, typer.Option(min=0.02, help="Speed of experiments at most, rad/s.")] = None,
    accuracy: Annotated[float, typer.Option(min=0.001, max=0.5, help="Force tolerance between local sets.")] = 0.02,
    plants: Annotated[int, typer.Option(min=1, max=1_000_000, help="Plants of the certificate.")] = 1000,
    budget: Annotated[int | None, typer.Option(min=1, help="Simulated plants for each rival's tuning.")] = None,
    rivals: Annotated[bool, typer.Option(help="Tune rivals and compare, on a virtual axis.")] = True,
    processes: Annotated[int, typer.Option(min=1, max=64, help="Worker processes.")] = 2,
    again: Annotated[
        list[str] | None,
        typer.Option(help="Do this step again, though it was done; repeatable.", autocompletion=walk_steps),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of excitation, tuning and virtual noise.")] = 1,
    yes: Annotated[
        bool, typer.Option("--yes", help="Agree to every question, and take what is offered where demands clash.")
    ] = False,
    socket: SocketOption = DEFAULT_SOCKET,
    as_json: JsonOption = False,
) -> None:
    """Walk from identification to validation in OUT; exit code 1 when a step's answer is no."""
    one_thread()
    from servod.client.processes import sigterm_as_interrupt
    from servod.lab.commission.report import failure, result, write_refusal
    from servod.lab.commission.state import GAINS
    from servod.lab.commission.steps import STEPS
    from servod.lab.commission.walk import Questions, StepFailed, Walk, WalkOptions, run

    axis = _virtual(plant, config, settings, encoder_counts, seed) if plant else _on_daemon(socket, config)
    need_folder("--out", out)
    walk = Walk(
        out,
        axis,
        WalkOptions(seed, travel, speed, accuracy, plants, budget, rivals, processes, again=tuple(again or ())),
        Questions(yes, _put),
        lambda title: _bar(title, as_json),
        lambda line: None if as_json else print(line, file=sys.stderr, flush=True),
    )
    try:
        with sigterm_as_interrupt():
            document = result(walk, run(walk, STEPS))
    except StepFailed as failed:
        page = write_refusal(walk, failed)
        if page is not None and not as_json:
            print(f"report: {page}", file=sys.stderr)
        if as_json:
            print_json(failure(walk, failed))
        raise
    if plant is not None:
        suggest("gains", "show", str(out / GAINS), why="the virtual axis has ended")
    if as_json:
        print_json(document)
    else:
        _print(document)


def _virtual(
    plant: Path, config: Path | None, settings: Path | None, encoder_counts: int | None, seed: int
) -> WalkAxis:
    from servod.client.open import VirtualWalkAxis
    from servod.common.yaml import load_model
    from servod.drivers.virtual.settings import VirtualAxisSettings
    from servod.formats.config import load_config
    from servod.formats.model.axis_model import load_rotary_model

    chosen = load_config(config) if config is not None else None
    devices = load_model(settings, VirtualAxisSettings) if settings is not None else None
    return VirtualWalkAxis(load_rotary_model(plant), seed, encoder_counts, chosen, devices)


def _on_daemon(socket: Path, config: Path | None) -> WalkAxis:
    from servod.client.open import DaemonWalkAxis
    from servod.formats.config import load_config

    if config is None:
        raise BadInput("--config", "nothing", "the configuration that the daemon runs with, or --plant")
    return DaemonWalkAxis(socket, load_config(config))


def _put(question: str) -> bool:
    return typer.confirm(question[0].upper() + question[1:], err=True)


@contextmanager
def _bar(title: str, quiet: bool) -> Iterator[OnProgress]:
    """The progress of one step: its title, and what it is doing."""
    with contextlib.ExitStack() as stack:
        on_progress = stack.enter_context(progress(title, quiet))
        yield lambda what, share: on_progress(f"{title}: {what}", share)


def _print(document: dict[str, Any]) -> None:
    from rich.table import Table

    table = Table("Controller", "RMS / mrad", "Largest / mrad", "Roughness / PD's", "", title="Trajectory (19)")
    for law, found in document["tracking"].items():
        table.add_row(*_cells(law, found))
    console = table_console()
    console.print(table)
    deployed = document["deployment"]["gains"]
    lines = [
        f"Deployed: {deployed['name']} version {deployed['version']}, certified, velocity filter "
        f"{document['velocity_cutoff_hz']:g} Hz.",
        f"Report: {document['files']['report']}",
        f"{document['seconds']['total']:.0f} s of work.",
    ]
    for line in lines:
        console.print(line, highlight=False, soft_wrap=True)


def _cells(law: str, found: dict[str, Any]) -> tuple[str, ...]:
    """A row of the table: what a law reached, its roughness, and whether that is more than the tuned laws may have."""
    if "failed" in found:
        return law, found["failed"]
    errors = f"{found['rms_error_mrad']:.4f}", f"{found['max_error_mrad']:.4f}"
    rough = f"{found['roughness_ratio']:.3g}" if "roughness_ratio" in found else ""
    over = not found.get("within_roughness_limit", True)
    notes = ("" if found["tuned"] else "deployed", f"over the limit of {found['roughness_limit']:g}" if over else "")
    return law, *errors, rough, ", ".join(filter(None, notes))
