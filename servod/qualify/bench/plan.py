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
from typing import Any

from servod.common.shipped import shipped
from servod.qualify.bench import speed, tick, wakeup, wall

# How long the laboratory takes: synthesis of both regions, a certificate, and a whole commissioning.
#
# Beside the figures of the loop; each on Table I's joint, the axis model that ships.


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
class Plan:
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


THOROUGH = Plan(3.0, 10, 20_000, 60.0, 600.0, 20.0, 300.0, plants=1000, commission=True)
QUICK = Plan(1.5, 6, 5_000, 10.0, 20.0, 4.0, 60.0, plants=100)


def measure(plan: Plan, tell: Callable[[str], None]) -> dict[str, Any]:
    """Measure everything, one after the other, so that nothing disturbs anything; `tell` hears what is going on."""
    tell("wake-up against cyclictest")
    woken = wakeup.measure(plan.wakeup_s, plan.wakeup_rounds)
    tell("work of one cycle")
    ticks, controller = tick.measure(plan.ticks)
    tell(f"two processes on the wall clock, {plan.wall_clock_s + plan.memory_s:.0f} s")
    wall_clock, memory = wall.measure(plan.wall_clock_s, plan.memory_s)
    synthesis, verification = _laboratory(plan, tell)
    tell("stepped and simulated speed")
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
        "commission": _commission(plan, tell),
    }


def _laboratory(plan: Plan, tell: Callable[[str], None]) -> tuple[dict[str, Any] | None, dict[str, Any] | None]:
    if not plan.plants:
        return None, None
    tell(f"synthesis, and a certificate with {plan.plants} plants")
    return measure_lab(plan.plants)


def _commission(plan: Plan, tell: Callable[[str], None]) -> dict[str, Any] | None:
    if not plan.commission:
        return None
    tell("a whole commissioning, four minutes")
    return commission()


def machine() -> dict[str, Any]:
    """The machine that the figures belong to."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    model = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())
    cores = sum(line.startswith("processor") for line in lines)
    return {"cpu": model, "cores": cores, "kernel": platform.release(), "python": sys.version.split()[0]}
