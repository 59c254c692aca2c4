"""`servoctl prove`: a blind trial of `servoctl diagnose` on axes that conceal something.

Works on files alone; needs the lab extra. Three processes: the first conceals and seals, the second is given the case
folders, the third opens the seal.
"""

from __future__ import annotations

import importlib.util
import json
import signal
import sys
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from servod.cli.common import JsonOption, example, need_folder, one_thread, run_stage
from servod.cli.groups import engines
from servod.common.errors import BadInput
from servod.common.files import BadFile
from servod.common.units import counted

if TYPE_CHECKING:
    from servod.qualify.blind.conceal import BlindTrial

_HELP = example(
    "Prove the diagnosis on cases that it has not seen: draw axes, conceal physics in them, record them, seal the "
    "truth and print its SHA-256; diagnose each folder in a process of its own; open the seal and score. An "
    "interrupted trial goes on where it was. Exit code 0: it was scored.",
    "servoctl prove --cases 24 --seed 7 --out out/prove",
    "servoctl prove --cases 120 --seed 8 --harder --out out/harder",
    "servoctl prove --cases 60 --null 60 --seed 9 --engine mujoco --out out/mujoco",
)


class Stage(StrEnum):
    """What `--only` may ask for."""

    CONCEAL = "conceal"
    DIAGNOSE = "diagnose"
    SCORE = "score"
    CASES = "cases"


def register(app: typer.Typer) -> None:
    """Add the verb to `app`."""
    app.command(name="prove", help=_HELP)(prove)


def prove(
    out: Annotated[Path, typer.Option(help="Folder of the trial: cases, sealed truth, answers, report.")],
    cases: Annotated[
        int | None, typer.Option(min=0, max=10_000, help="How many mixed cases; 120, or none beside --null alone.")
    ] = None,
    null: Annotated[int, typer.Option(min=0, max=10_000, help="So many more that conceal nothing.")] = 0,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the trial; the same draws the same cases.")] = 1,
    harder: Annotated[
        bool, typer.Option("--harder", help="1 % of other effects, four times the noise, other forms in the plant.")
    ] = False,
    engine: Annotated[
        str, typer.Option(help="Who moves the axes: own, or mujoco (servod[sim]).", autocompletion=engines)
    ] = "own",
    jobs: Annotated[int, typer.Option(min=1, max=64, help="Diagnoses at a time.")] = 2,
    time_limit: Annotated[float, typer.Option(min=1.0, max=1e5, help="Of each diagnosis, s.")] = 120.0,
    only: Annotated[
        Stage | None, typer.Option(help="One stage alone; `cases`: open cases into OUT, truth and all.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Run the trial in OUT."""
    one_thread()
    if only not in (Stage.DIAGNOSE, Stage.SCORE):
        _need_own_folder(out)
    need_folder("--out", out, alone=True)
    trial = _trial(cases, null, seed, harder, engine)
    match only:
        case None:
            drawn = [f"--cases={trial.cases}", f"--null={null}", f"--seed={seed}", f"--engine={engine}"]
            drawn += ["--harder"] if harder else []
            _in_processes(out, drawn, [f"--jobs={jobs}", f"--time-limit={time_limit}"], as_json)
        case Stage.CONCEAL | Stage.CASES:
            _conceal(out, trial, sealed=only is Stage.CONCEAL)
        case Stage.DIAGNOSE:
            _diagnose(out, jobs, time_limit)
        case Stage.SCORE:
            _score(out, as_json)


def _need_own_folder(out: Path) -> None:
    """See that nothing of other origin lies in `out`: a trial seals and overwrites what is there. Raises BadInput."""
    from servod.qualify.blind.conceal import foreign_in

    if foreign := foreign_in(out):
        listed = ", ".join(foreign[:3]) + (f" and {len(foreign) - 3} more" if len(foreign) > 3 else "")
        raise BadInput(f"--out {out}", listed, "an empty folder, or one of an earlier `servoctl prove`")


def _in_processes(out: Path, drawn: list[str], diagnosed: list[str], as_json: bool) -> None:
    """Each stage in a process of its own; a stage that fails ends the trial as it ended, with its document."""
    from servod.cli.common import print_json

    stages: dict[Stage, list[str]] = {Stage.CONCEAL: drawn, Stage.DIAGNOSE: diagnosed, Stage.SCORE: []}
    for stage, options in stages.items():
        as_asked = ["--json"] if as_json else []
        code, document = run_stage(["prove", f"--out={out}", f"--only={stage}", *options, *as_asked], capture=as_json)
        if document:
            print_json(json.loads(document))
        if code != 0:
            raise typer.Exit(code)


def _trial(cases: int | None, null: int, seed: int, harder: bool, engine: str) -> BlindTrial:
    """What was asked for. Raises BadInput where it is nothing, or the engine is not there."""
    from servod.qualify.blind.conceal import BlindTrial
    from servod.qualify.blind.plan import Engine

    if engine not in set(Engine):
        raise BadInput("--engine", repr(engine), ", ".join(Engine))
    if engine == Engine.MUJOCO and importlib.util.find_spec("mujoco") is None:
        raise BadInput("--engine", "no MuJoCo is installed", "own, or pip install 'servod[sim]'")
    mixed = (0 if null else 120) if cases is None else cases
    if mixed + null == 0:
        raise BadInput("--cases", "0", "1 case or more, here or as --null")
    return BlindTrial(mixed, seed, harder, null, Engine(engine))


def _conceal(out: Path, trial: BlindTrial, sealed: bool) -> None:
    from dataclasses import replace

    from servod.cli.common import progress
    from servod.qualify.blind.conceal import FILE, conceal, open_cases, read_trial, write_trial
    from servod.qualify.blind.plan import plans, settings_of

    there = read_trial(out)
    if there is not None and not there.same(trial):
        raise BadInput(str(out / FILE), str(there), "the same trial, or another folder")
    settings = settings_of(trial.harder, trial.engine)
    if there is None:
        with progress("conceal", quiet=False) as on_progress:
            make = conceal if sealed else open_cases
            drawn = plans(trial.cases, trial.seed, settings, trial.null)
            digest = make(drawn, settings, out, lambda n, of: on_progress(f"concealed {n} of {of}", n / of))
        if digest is None:
            return
        there = replace(trial, sha256=digest)
        write_trial(out, there)
    sealed_truth = f"the truth of {counted(trial.cases + trial.null, 'case')}"
    print(f"sealed: SHA-256 {there.sha256} of {sealed_truth}", file=sys.stderr, flush=True)


def _diagnose(out: Path, jobs: int, time_limit: float) -> None:
    from servod.qualify.blind.examine import Examiner

    _sealed(out)
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # what runs ends with us, whoever ends us
    Examiner(out, time_limit).run(jobs, _line)


def _line(name: str, done: int, of: int) -> None:
    """Progress on standard error, a line a case."""
    print(f"{name} diagnosed: {done} of {of}", file=sys.stderr, flush=True)


def _score(out: Path, as_json: bool) -> None:
    from servod.cli.common import print_json, progress
    from servod.qualify.blind.document import score, write

    trial = _sealed(out)
    with progress("score", quiet=as_json) as on_progress:
        document = score(trial, out, lambda n, of: on_progress(f"scored {n} of {of}", n / of))
        write(document, out)
    if as_json:
        print_json(document)
    else:
        from servod.qualify.blind.tables import text

        print(text(document))
        print(f"Page: {out / 'prove.html'}; tables: {out / 'prove.md'}; all figures: {out / 'prove.json'}")


def _sealed(out: Path) -> BlindTrial:
    """The trial that was sealed in `out`. Raises BadInput when there is none."""
    from servod.qualify.blind.conceal import FILE, read_trial

    trial = read_trial(out)
    if trial is None:
        needed = "a folder in which `servoctl prove --only conceal` was done"
        raise BadFile(str(out / FILE), "there is no such file", needed, more=needed)
    return trial
