"""`servoctl identify`: experiments on the axis, or their recordings, become an axis model with intervals."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from servod.cli.common import (
    DEFAULT_SOCKET,
    JsonOption,
    SocketOption,
    connect,
    example,
    need_file,
    need_folder,
    one_thread,
    print_json,
    suggest,
    table_console,
)
from servod.common.errors import BadInput
from servod.common.files import write_file

if TYPE_CHECKING:
    from servod.client.axis import AxisClient
    from servod.common.progress import OnProgress
    from servod.formats.model.axis_model import AxisModel
    from servod.lab.identify.analysis import Analysis

    Job = Callable[["_Walk", OnProgress], Analysis]

_HELP = example(
    "Identify the axis: noise, break-away, presliding stiffness, inertia, delay, friction map. Ctrl-C leaves it off.",
    "servoctl identify --out model.yaml --config /etc/servod/config/can0.yaml",
    "servoctl identify --out model.yaml --plant joint.yaml",
    "servoctl identify --out model.yaml --recordings model_recordings",
)


def register(app: typer.Typer) -> None:
    """Add the verb to `app`."""
    app.command("identify", help=_HELP)(identify)


def identify(
    out: Annotated[
        Path,
        typer.Option(
            help="Axis model to write; recordings go to a folder beside it, earlier ones are set aside in it."
        ),
    ],
    plant: Annotated[Path | None, typer.Option(help="Start a virtual axis with this joint, SYNC-stepped.")] = None,
    config: Annotated[Path | None, typer.Option(help="Axis configuration; needed on a daemon's axis.")] = None,
    recordings: Annotated[Path | None, typer.Option(help="No axis: fit the recordings in this folder.")] = None,
    before: Annotated[Path | None, typer.Option(help="Earlier model: say what has changed since.")] = None,
    travel: Annotated[float | None, typer.Option(min=0.02, help="Travel to each side at most, rad.")] = None,
    speed: Annotated[
        float | None, typer.Option(min=0.02, help="Speed at most, rad/s; seen above it, the walk ends.")
    ] = None,
    settings: Annotated[Path | None, typer.Option(help="Virtual axis: what drive and encoder really are.")] = None,
    encoder_counts: Annotated[int | None, typer.Option(min=4, help="Virtual axis: counts per turn.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of excitation and virtual noise.")] = 1,
    resume: Annotated[bool, typer.Option(help="Go on where an interrupted walk with the same --out ended.")] = False,
    socket: SocketOption = DEFAULT_SOCKET,
    as_json: JsonOption = False,
) -> None:
    """Run or read the experiments, fit, write the model."""
    one_thread()
    from servod.formats.model.axis_model import axis_model_yaml
    from servod.lab.identify.result import document, model_of

    need_file("--out", out)
    if recordings is None:
        need_folder("--out", recordings_folder(out))
    old = _identified_in(before)
    if recordings is not None:
        job = _from_recordings(recordings)
    elif plant is not None:
        job = _virtual(plant, config, settings, encoder_counts, seed)
    else:
        job = _on_daemon(socket, config)
    with _progress(quiet=as_json) as on_progress:
        analysis = job(_Walk(recordings_folder(out), travel, speed, seed, resume), on_progress)
    model = model_of(analysis)
    write_file(out, axis_model_yaml(model))
    suggest("synthesize", "--model", str(out), "--out", "gains.yaml", why="a gain set for this axis")
    found = document(analysis) | {"model": str(out)} | _changes(old, model)
    if as_json:
        print_json(found)
    else:
        _print(found)


def recordings_folder(out: Path) -> Path:
    """Where the recordings of a model file go."""
    return out.with_name(out.stem + "_recordings")


class _Walk(NamedTuple):
    """What every walk on an axis is given."""

    folder: Path
    travel: float | None
    speed: float | None
    seed: int
    resume: bool

    def on(self, axis: AxisClient, on_progress: OnProgress, subject: str) -> Analysis:
        """Run all experiments on this axis, and switch it off whatever ends them; `subject` says which one it is."""
        from servod.client.processes import sigterm_as_interrupt
        from servod.lab.identify.walk import identify as walk

        with sigterm_as_interrupt():
            return walk(
                axis, self.folder, on_progress, travel_rad=self.travel, speed_rad_s=self.speed, seed=self.seed,
                resume=self.resume, subject=subject,
            )  # fmt: skip


def _from_recordings(folder: Path) -> Job:
    """Reads at once, so that a mistake is told before anything begins."""
    from servod.lab.identify.analysis import analyse
    from servod.lab.identify.store import load, load_devices

    traces, devices = load(folder), load_devices(folder)
    return lambda _walk, _on_progress: analyse(traces, devices)


def _virtual(plant: Path, config: Path | None, settings: Path | None, encoder_counts: int | None, seed: int) -> Job:
    from servod.client.stepped import SteppedAxis
    from servod.client.virtual import virtual_session
    from servod.common.yaml import load_model
    from servod.drivers.virtual.settings import VirtualAxisSettings
    from servod.formats.config import load_config
    from servod.formats.model.axis_model import axis_model_yaml, load_rotary_model

    joint, chosen = load_rotary_model(plant), load_config(config) if config is not None else None
    devices = load_model(settings, VirtualAxisSettings) if settings is not None else None

    def job(walk: _Walk, on_progress: OnProgress) -> Analysis:
        with tempfile.TemporaryDirectory(prefix="servod-identify-") as folder:
            session = virtual_session(joint, Path(folder), encoder_counts, seed, chosen, devices)
            return walk.on(SteppedAxis(session, Path(folder)), on_progress, axis_model_yaml(joint))

    return job


def _on_daemon(socket: Path, config: Path | None) -> Job:
    from servod.client.under_daemon import DaemonAxis
    from servod.formats.config import load_config

    if config is None:
        raise BadInput(
            "--config", "nothing", "the configuration that the daemon runs with, or --plant, or --recordings"
        )
    chosen = load_config(config)

    def job(walk: _Walk, on_progress: OnProgress) -> Analysis:
        with connect(socket) as client:
            return walk.on(DaemonAxis(client, chosen), on_progress, chosen.name)

    return job


def _identified_in(before: Path | None) -> AxisModel | None:
    if before is None:
        return None
    from servod.formats.model.axis_model import load_axis_model

    model = load_axis_model(before)
    if model.identified is None:
        raise BadInput(f"{before}: identified", "nothing", "a model that servoctl identify wrote")
    return model


def _changes(old: AxisModel | None, new: AxisModel) -> dict[str, Any]:
    from servod.lab.identify.result import changes

    if old is None or old.identified is None or new.identified is None:
        return {}
    return {"changes": changes(old.identified, new.identified)}


@contextmanager
def _progress(quiet: bool) -> Iterator[Callable[[str, float], None]]:
    """One bar over the whole walk on standard error; nothing when quiet."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description:20}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), disable=quiet) as bars:
        task = bars.add_task("identify", total=1.0)
        yield lambda what, share: bars.update(task, description=what, completed=share)


def _print(found: dict[str, Any]) -> None:
    from rich.table import Table

    table = Table("Quantity", "Value", "95 % interval", "Unit", title="Identified")
    for name, number in found["identified"].items():
        interval = f"{number['low']:.4g} to {number['high']:.4g}"
        table.add_row(name, f"{number['value']:.5g}", interval, number["unit"])
    console = table_console()
    console.print(table)
    for name, number in found["identified"].items():
        if number["note"]:
            console.print(f"{name}: {number['note']}.", highlight=False)
    for name, remedy in found["not_identifiable"].items():
        console.print(f"Not identifiable from these excitations: {name}. {remedy}.", highlight=False)
    for line in found.get("changes", []):
        console.print(f"Changed: {line}.", highlight=False)
    console.print(f"Model: {found['model']}", highlight=False, soft_wrap=True)
