"""Diagnose recordings of three real machines and print what was missing, with errors before and after.

Errors are of recordings that the diagnosis has not seen; of EMPS, where its one session is all that it may see, they
are of that session, and its row says so. Its second session is told apart, before and after what changed there.

    python scripts/real_machines.py --recordings ../shared/recordings --out out/machines

`--recordings` holds `emps`, `odrive_cogging` and `bam_xl330` (sources in docs/explanation/real-machines.md); models and
maps are in `examples`. Diagnoses and windows run through `servoctl diagnose` and `servoctl replay`, as one would by
hand; the torque mismatch is what the predictor of `servoctl diagnose` leaves with each model as it is.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from servod.formats.model.axis_model import load_axis_model
from servod.lab.diagnose.data.intake import load_traces
from servod.lab.diagnose.predict.predict import Predictor
from servod.lab.recordings import load_recording

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"

#: Length of the windows that restart from the recording, s.
HORIZONS = ("0.25", "1")

#: Length of one lap of EMPS, s.
LAP_S = "6.24"


@dataclass(frozen=True)
class Machine:
    """Files of one machine: those that a diagnosis sees, those that it does not, and its name in `examples`."""

    example: str
    seen: tuple[str, ...]
    unseen: tuple[str, ...]

    def judged(self) -> dict[str, str]:
        """Files that errors are told of, and what their rows are called: the unseen ones, where there are any."""
        told = "" if self.unseen else " (the fit has seen it)"
        return {name: f"{self.example}, {Path(name).name}{told}" for name in self.unseen or self.seen}


XL330 = "bam_xl330"
ODRIVE = "odrive_cogging"


def _odrive(*runs: int) -> tuple[str, ...]:
    """Runs without the compensation of cogging."""
    return tuple(f"{ODRIVE}/slow_turn_nocomp_{run}.csv.gz" for run in runs)


MACHINES = (
    Machine("emps", ("emps/DATA_EMPS.mat",), ()),
    Machine("odrive", _odrive(0), _odrive(1, 2)),
    Machine(
        "xl330",
        tuple(f"{XL330}/{run}.csv.gz" for run in ("sin_sin_kp200", "sin_time_square_kp100", "sin_time_square_kp200")),
        tuple(f"{XL330}/{run}.csv.gz" for run in ("sin_sin_kp100", "sin_sin_kp400", "sin_time_square_kp400")),
    ),
)


def servoctl(*arguments: str | Path) -> dict[str, Any]:
    """The JSON document of a command."""
    program = [str(Path(sys.executable).with_name("servoctl")), *(str(argument) for argument in arguments), "--json"]
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(program, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    document: dict[str, Any] = json.loads(done.stdout)
    return document


def diagnosed(machine: Machine, model: Path, recordings: list[Path], out: Path, *more: str) -> dict[str, Any]:
    """What `servoctl diagnose` says of the recordings."""
    out.mkdir(parents=True, exist_ok=True)
    column_map = EXAMPLES / f"{machine.example}_map.yaml"
    found = servoctl("diagnose", "--model", model, "--map", column_map, *recordings, "--out", out, *more)
    print(f"\n{machine.example}: {', '.join(path.name for path in recordings)}: {found['verdict']}")
    print(f"  {found['summary']}")
    for finding in found["findings"]:
        print(f"  {finding['effect']} ({finding['confidence']:.2f}): {finding['statement']}", flush=True)
    for name, change in found["recalibrated"].items():
        print(f"  recalibrated: {name} {change['from']:.5g} -> {change['to']:.5g} {change['unit']}")
    return found


def window_errors(machine: Machine, model: Path, recording: Path, *more: str) -> list[float]:
    """Position errors of windows of HORIZONS, thousandths of a rad or m, RMS."""
    column_map = EXAMPLES / f"{machine.example}_map.yaml"
    same = ("replay", "--model", model, "--map", column_map, recording, *more, "--horizon")
    unit = "m" if machine.example == "emps" else "rad"
    return [1e3 * float(servoctl(*same, horizon)[f"rms_error_{unit}"]) for horizon in HORIZONS]


def errors(machine: Machine, model: Path, recording: Path, from_s: str | None = None) -> list[float]:
    """Position errors of windows, and the torque mismatch (mN*m, or N of a linear axis), RMS."""
    more = () if from_s is None else ("--from-s", from_s)
    return [*window_errors(machine, model, recording, *more), mismatch(machine, model, recording, from_s)]


def mismatch(machine: Machine, model: Path, recording: Path, from_s: str | None) -> float:
    """Torque mismatch of a recording, mN*m or N RMS, as the observer of the plain model shows it."""
    plain = load_axis_model(EXAMPLES / f"{machine.example}.yaml")
    loaded = load_recording(recording, EXAMPLES / f"{machine.example}_map.yaml")
    traces, refused = load_traces([loaded.between(None if from_s is None else float(from_s), None)], plain)
    if refused:
        raise SystemExit(f"{recording}: {refused[0].reason}")
    predictor = Predictor(traces, plain)
    left = predictor.mismatch(load_axis_model(model))[predictor.counts]
    return float(np.sqrt(np.mean(left**2))) * (1.0 if predictor.linear else 1e3)


def row(what: str, before: list[float], after: list[float]) -> None:
    """One row of the table."""
    cells = " | ".join(f"{old:.3g} → {new:.3g}" for old, new in zip(before, after, strict=True))
    print(f"| {what} | {cells} |")


def main() -> None:
    """Diagnose every machine, then EMPS's second session; print a table of errors before and after."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings", type=Path, required=True)
    parser.add_argument("--out", type=Path, default=Path("out/machines"))
    parser.add_argument("--time-limit", default="300", help="seconds for each search")
    given = parser.parse_args()
    rows: list[tuple[str, list[float], list[float]]] = []
    for machine in MACHINES:
        seen = [given.recordings / name for name in machine.seen]
        plain, out = EXAMPLES / f"{machine.example}.yaml", given.out / machine.example
        diagnosed(machine, plain, seen, out, "--time-limit", given.time_limit)
        for name, what in machine.judged().items():
            pair = [errors(machine, model, given.recordings / name) for model in (plain, out / "model.yaml")]
            rows.append((what, *pair))
    rows += second_session(given.recordings, given.out, given.time_limit)
    print("\n| recording | windows of 0.25 s / mm, mrad | of 1 s / mm, mrad | torque mismatch / N, mN·m |")
    print("| --- | --- | --- | --- |")
    for what, before, after in rows:
        row(what, before, after)


def second_session(recordings: Path, out: Path, time_limit: str) -> list[tuple[str, list[float], list[float]]]:
    """EMPS on another day: what has changed by its first lap, judged on the other laps."""
    emps = MACHINES[0]
    pulses = recordings / "emps/DATA_EMPS_PULSES.mat"
    first = out / "emps/model.yaml"
    diagnosed(emps, first, [pulses], out / "emps_pulses", "--to-s", LAP_S, "--time-limit", time_limit)
    models = (EXAMPLES / "emps.yaml", first, out / "emps_pulses/model.yaml")
    plain, before, after = (errors(emps, model, pulses, LAP_S) for model in models)
    what = "emps, DATA_EMPS_PULSES.mat, laps 2 to 4"
    return [(f"{what}, model of DATA_EMPS", plain, before), (f"{what}, what changed put in", before, after)]


if __name__ == "__main__":
    main()
