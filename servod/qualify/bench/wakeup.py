"""Wake-up of the loop against cyclictest: same core, priority and interval, one straight after the other.

The loop's own waiting is what is measured: servod.runtime.loop.process.run with a cycle that only notes its lag, under
the same real-time grants, in a process of its own (`python -m servod.qualify.bench.wakeup CORE PRIORITY CYCLES`).
"""

from __future__ import annotations

import json
import math
import shutil
import subprocess
import sys
import tempfile
from array import array
from pathlib import Path
from typing import Any

from servod.client.processes import last_core
from servod.common.clock import WallClock
from servod.common.units import NS_PER_US
from servod.runtime.loop.process import run
from servod.runtime.loop.realtime import apply_realtime

INTERVAL_US = 1000
PRIORITY = 80
#: Cycles at the start that are not counted: caches and clocks settle.
_WARM_UP = 200
_HISTOGRAM_US = 5000
HOW_TO_INSTALL = "cyclictest is not installed: apt install rt-tests"


class LagProbe:
    """What servod.runtime.loop.process.run calls instead of a cycle: notes the lag of each wake-up, in preallocated
    memory."""

    period_ns = INTERVAL_US * NS_PER_US

    def __init__(self, cycles: int) -> None:
        self._lags_ns = array("q", bytes(8 * cycles))
        self._count = 0

    @property
    def finished(self) -> bool:
        """All cycles are done."""
        return self._count >= len(self._lags_ns)

    def step(self, deadline_ns: int, woke_ns: int, skipped: int) -> None:
        """One wake-up; skipped periods belong to its lag."""
        self._lags_ns[self._count] = woke_ns - deadline_ns + skipped * self.period_ns
        self._count += 1

    def lags_us(self) -> list[float]:
        """The lags without the warm-up, sorted."""
        return sorted(lag / NS_PER_US for lag in self._lags_ns[_WARM_UP:])


def measure(duration_s: float, rounds: int) -> dict[str, Any]:
    """Median and p99 of both in each round, and best round against best round; None where cyclictest is missing.

    Rounds are short and many, in turn: a host's stalls then spoil single rounds of both, not the comparison.
    """
    core, cycles = last_core() or 0, round(duration_s * 1e6 / INTERVAL_US) + _WARM_UP
    pairs = [(_loop(core, cycles), _cyclictest(core, cycles)) for _ in range(rounds)]
    result: dict[str, Any] = {
        "median_ratio": None,
        "p99_ratio": None,
        "rounds": [{"loop_us": loop, "cyclictest_us": cyclic} for loop, cyclic in pairs],
        "core": core,
        "seconds": duration_s,
    }
    compared = [(loop, cyclic) for loop, cyclic in pairs if cyclic is not None]
    if not compared:
        return result | {"note": HOW_TO_INSTALL if shutil.which("cyclictest") is None else "cyclictest refused to run"}
    for name in ("median", "p99"):
        best_loop = min(loop[name] for loop, _ in compared)
        best_cyclic = min(cyclic[name] for _, cyclic in compared)
        result[f"{name}_ratio"] = best_loop / best_cyclic
    return result


def _loop(core: int, cycles: int) -> dict[str, float]:
    command = [sys.executable, "-m", "servod.qualify.bench.wakeup", str(core), str(PRIORITY), str(cycles)]
    output = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    figures: dict[str, float] = json.loads(output)
    return figures


def _cyclictest(core: int, cycles: int) -> dict[str, float] | None:
    """Median and p99 of cyclictest's histogram; its resolution is 1 us. None when it is missing or refused."""
    program = shutil.which("cyclictest")
    if program is None:
        return None
    with tempfile.TemporaryDirectory(prefix="servod-bench-") as folder:
        file = Path(folder) / "cyclictest.json"
        command = [
            program, "--quiet", "--mlockall", "--threads=1", f"--affinity={core}", f"--priority={PRIORITY}",
            f"--interval={INTERVAL_US}", f"--loops={cycles}", f"--histogram={_HISTOGRAM_US}", f"--json={file}",
        ]  # fmt: skip
        done = subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, check=False)
        if done.returncode != 0 or not file.exists():
            return None
        histogram = json.loads(file.read_text(encoding="utf-8"))["thread"]["0"]["histogram"]
    counts = sorted((int(us), count) for us, count in histogram.items())
    return {"median": _percentile(counts, 0.5), "p99": _percentile(counts, 0.99)}


def _percentile(counts: list[tuple[int, int]], share: float) -> float:
    """The value below which `share` of the counts lie; a count at n us stands for n to n + 1, its middle is taken."""
    left = share * sum(count for _, count in counts)
    for value_us, count in counts:
        left -= count
        if left <= 0:
            return value_us + 0.5
    return math.nan


def main() -> None:
    """The probe process: prints median and p99 of the loop's lag as JSON."""
    core, priority, cycles = map(int, sys.argv[1:])
    probe = LagProbe(cycles)
    apply_realtime(core, priority)
    run(probe, WallClock())
    lags = probe.lags_us()
    print(json.dumps({"median": lags[len(lags) // 2], "p99": lags[int(0.99 * len(lags))]}))


if __name__ == "__main__":
    main()
