"""What is measured for how long, and the one document that comes out."""

from __future__ import annotations

import json
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from servod.common.files import write_file
from servod.common.shipped import shipped
from servod.qualify.bench import speed, tick, wakeup
from servod.qualify.bench import wall_clock as wall

if TYPE_CHECKING:
    from rich.console import Console

# --- The laboratory --------------------------------------------------------------------------------------------------
# How long the laboratory takes: synthesis of both regions, a certificate, and a whole commissioning. Each on Table I's
# joint, the axis model that ships.


PROCESSES = 2


def measure_lab(plants: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """Seconds of a synthesis, imports not counted, and of a verification with `plants` simulated plants."""
    from servod.common.errors import AnswerIsNo
    from servod.formats.gains.gain_set import GainSet
    from servod.formats.model.axis_model import load_axis_model
    from servod.lab.synthesize.gain_set import synthesize
    from servod.lab.verify.certify import verify

    path = shipped("gains/axes/table1_joint.yaml")
    started = time.perf_counter()
    gains = synthesize(load_axis_model(path), model_path=path)
    synthesis_s = time.perf_counter() - started
    if not isinstance(gains, GainSet):
        raise AnswerIsNo(f"benchmark: no design for {path}: {'; '.join(gains.clashes)}")
    started = time.perf_counter()
    valid = verify(gains, plants, processes=PROCESSES, least_plants=plants).valid
    verification = {"seconds": time.perf_counter() - started, "plants": plants, "valid": valid}
    return {"seconds": synthesis_s}, verification


def commission() -> dict[str, Any]:
    """Seconds of `servoctl commission` on the virtual axis, from its start to its end, and of each step."""
    plant = shipped("gains/axes/table1_joint.yaml")
    with tempfile.TemporaryDirectory(prefix="servod-bench-") as folder:
        command = [sys.executable, "-m", "servod.cli", "commission", "--plant", str(plant), "--out", folder, "--json"]
        started = time.perf_counter()
        done = subprocess.run(command, stdout=subprocess.PIPE, check=True)
        return {"seconds": time.perf_counter() - started, "steps": json.loads(done.stdout)["seconds"]}


@dataclass(frozen=True)
class BenchSettings:
    """Lengths of the measurements, in s unless the name says otherwise; no `plants`: the laboratory is left out."""

    wakeup_s: float
    wakeup_rounds: int
    ticks: int
    wall_clock_s: float
    memory_s: float
    stepped_s: float
    simulated_s: float
    plants: int = 0
    commission: bool = False


THOROUGH = BenchSettings(3.0, 10, 20_000, 60.0, 600.0, 20.0, 300.0, plants=1000, commission=True)
QUICK = BenchSettings(1.5, 6, 5_000, 10.0, 20.0, 4.0, 60.0, plants=100)


def measure(plan: BenchSettings, on_progress: Callable[[str], None]) -> dict[str, Any]:
    """Measure everything, one after the other, so that nothing disturbs anything; `on_progress` hears what goes on."""
    on_progress("wake-up against cyclictest")
    woken = wakeup.measure(plan.wakeup_s, plan.wakeup_rounds)
    on_progress("work of one cycle")
    ticks, controller = tick.measure(plan.ticks)
    on_progress(f"two processes on the wall clock, {plan.wall_clock_s + plan.memory_s:.0f} s")
    wall_clock, memory = wall.measure(plan.wall_clock_s, plan.memory_s)
    synthesis, verification = _laboratory(plan, on_progress)
    on_progress("stepped and simulated speed")
    return {
        "machine": machine(),
        "wakeup": woken,
        "tick_us": ticks,
        "controller_us": controller,
        "wall_clock": wall_clock,
        "stepped_speed": speed.stepped(plan.stepped_s),
        "simulator_speed": speed.simulated(plan.simulated_s),
        "memory": memory,
        "synthesis": synthesis,
        "verification": verification,
        "commission": _commission(plan, on_progress),
    }


def _laboratory(
    plan: BenchSettings, on_progress: Callable[[str], None]
) -> tuple[dict[str, Any] | None, dict[str, Any] | None]:
    if not plan.plants:
        return None, None
    on_progress(f"synthesis, and a certificate with {plan.plants} plants")
    return measure_lab(plan.plants)


def _commission(plan: BenchSettings, on_progress: Callable[[str], None]) -> dict[str, Any] | None:
    if not plan.commission:
        return None
    on_progress("a whole commissioning, four minutes")
    return commission()


def machine() -> dict[str, Any]:
    """The machine that the figures belong to."""
    lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    model = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())
    cores = sum(line.startswith("processor") for line in lines)
    return {"cpu": model, "cores": cores, "kernel": platform.release(), "python": sys.version.split()[0]}


# --- The table -------------------------------------------------------------------------------------------------------
# The benchmark's figures as a table beside what they shall reach, and as a file.


class BenchTarget(NamedTuple):
    """One row: where the figure stands in the document, how it is written, and what it shall be."""

    label: str
    keys: tuple[str, ...]
    text: str
    bound: str
    met: Callable[[float], bool]
    seconds: float = 0.0  # how long the target wants to be watched; the document says how long it was
    plants: int = 0  # how many plants the target is for; the document says how many there were

    def verdict(self, document: dict[str, Any]) -> str:
        """Empty when the target is met; else "missed", or why it could not be judged."""
        value = figure(document, self)
        if value is None:
            return str(document["wakeup"].get("note", "not measured"))
        if self.seconds:
            measured_s = float(document[self.keys[0]]["seconds"])
            if round(measured_s) < self.seconds:
                return f"not judged (measured {measured_s:g} s)"
        if self.plants and document[self.keys[0]]["plants"] < self.plants:
            return f"not judged (measured with {document[self.keys[0]]['plants']} plants)"
        return "" if self.met(value) else "missed"


TARGETS = (
    BenchTarget(
        "wake-up, median against cyclictest", ("wakeup", "median_ratio"), "{:.2f}", "at most 1.3", lambda x: x <= 1.3
    ),
    BenchTarget("wake-up, p99 against cyclictest", ("wakeup", "p99_ratio"), "{:.2f}", "at most 2", lambda x: x <= 2.0),
    BenchTarget("whole tick, median", ("tick_us", "median"), "{:.1f} µs", "at most 45 µs", lambda x: x <= 45.0),
    BenchTarget("whole tick, p99", ("tick_us", "p99"), "{:.1f} µs", "", lambda _: True),
    BenchTarget(
        "controller alone, median", ("controller_us", "median"), "{:.1f} µs", "at most 10 µs", lambda x: x <= 10.0
    ),
    BenchTarget("controller alone, p99", ("controller_us", "p99"), "{:.1f} µs", "", lambda _: True),
    BenchTarget(
        "missed periods", ("wall_clock", "missed_share"), "{:.3%}", "at most 0.3 % in 60 s", lambda x: x <= 0.003, 60.0
    ),
    BenchTarget(
        "deadline to torque frame, median",
        ("wall_clock", "deadline_to_torque_us"),
        "{:.0f} µs",
        "at most 250 µs",
        lambda x: x <= 250.0,
    ),
    BenchTarget("stepped, against real time", ("stepped_speed",), "{:.1f}×", "at least 5×", lambda x: x >= 5.0),
    BenchTarget("simulator, against real time", ("simulator_speed",), "{:.0f}×", "at least 500×", lambda x: x >= 500.0),
    BenchTarget(
        "growth of memory", ("memory", "growth_mib"), "{:.2f} MiB", "below 1 MiB in 10 min", lambda x: x < 1.0, 600.0
    ),
    BenchTarget("synthesis of both regions", ("synthesis", "seconds"), "{:.1f} s", "at most 2 s", lambda x: x <= 2.0),
    BenchTarget(
        "verification with 1000 plants",
        ("verification", "seconds"),
        "{:.0f} s",
        "at most 60 s",
        lambda x: x <= 60.0,
        plants=1000,
    ),
    BenchTarget("commission", ("commission", "seconds"), "{:.0f} s", "at most 240 s", lambda x: x <= 240.0),
)


def figure(document: dict[str, Any], target: BenchTarget) -> float | None:
    """The figure of one row; None when it could not be measured."""
    value: Any = document
    for key in target.keys:
        value = None if value is None else value.get(key)
    return None if value is None else float(value)


def shown(document: dict[str, Any], target: BenchTarget) -> str:
    """The figure of one row as people read it."""
    value = figure(document, target)
    return "not measured" if value is None else target.text.format(value)


def print_table(document: dict[str, Any], console: Console) -> None:
    """Print every figure beside its target, and what it was measured on."""
    from rich.table import Table

    machine = document["machine"]
    measured_on = f"{machine['cpu']}, {machine['cores']} cores, Linux {machine['kernel']}, Python {machine['python']}"
    table = Table("Figure", "Measured", "Target", "")
    for target in TARGETS:
        table.add_row(target.label, shown(document, target), target.bound, target.verdict(document))
    console.print(measured_on, highlight=False, markup=False)
    console.print(table)
    wall, memory = document["wall_clock"], document["memory"]
    console.print(
        f"Wall clock over {wall['seconds']:.0f} s, memory over {memory['seconds']:.0f} s, wake-up best of "
        f"{len(document['wakeup']['rounds'])} rounds of {document['wakeup']['seconds']:.0f} s.",
        highlight=False,
    )


def write_json(document: dict[str, Any], path: Path) -> None:
    """Replace `path` by the document. Raises BadInput when that is not possible."""
    write_file(path, json.dumps(document, indent=2))
