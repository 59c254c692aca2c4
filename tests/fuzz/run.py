"""Fuzzes every way into servod for a bounded time; each target in a process of its own, whose death is a finding too.

    python -m tests.fuzz.run --seconds 60                  a share for each target
    python -m tests.fuzz.run --seconds 60 --jobs 2         the same in half the time, on two cores
    python -m tests.fuzz.run --seconds 600 --target mcap   one target, longer
    python -m tests.fuzz.run --seconds 60 --json out.json  the figures, with every crash, for programs

Where atheris can be had (`pip install -e '.[fuzz]'`), half of each share goes to inputs that atheris changes octet by
octet, and half to choices that it makes for the target's strategy, both guided by coverage. Elsewhere hypothesis draws
from the strategies alone, and a line says so. Exit code 1 when an input crashed; it is kept in the folder --out.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from pathlib import Path

try:
    from tests.fuzz.target import TARGETS
except ModuleNotFoundError as error:
    sys.exit(f"fuzzing needs the tests' tools: pip install -e '.[lab,dev]' ({error.name} is missing)")

ROOT = Path(__file__).resolve().parents[2]
#: What a process may take beyond its time, for its start and its last input, s.
_GRACE_S = 120.0
_COVERAGE = re.compile(r"\bcov: (\d+)")


@dataclass
class Row:
    """What one target showed in one way; `coverage` in edges, from the seeds alone and with all inputs."""

    target: str
    way: str
    inputs: int = 0
    seconds: float = 0.0
    coverage: list[int] = field(default_factory=list)
    crashes: list[dict[str, str]] = field(default_factory=list)


def fuzz(target: str, way: str, seconds: float, out: Path) -> Row:
    """Fuzz one target in one way; a process that an input killed is started again for the rest of the time."""
    row, folder = Row(target, way), out / target / way
    folder.mkdir(parents=True, exist_ok=True)
    end_s = time.monotonic() + seconds
    while (left_s := end_s - time.monotonic()) > 0.2:
        started_s = time.monotonic()
        died = _one_process(row, folder, left_s)
        row.seconds += time.monotonic() - started_s
        if not died:
            break
    row.crashes += _crashes(folder)
    return row


def _one_process(row: Row, folder: Path, seconds: float) -> bool:
    """One process of the target; whether it died of an input, which is kept then."""
    (folder / "now.bin").unlink(missing_ok=True)
    (folder / "figures.json").unlink(missing_ok=True)
    log = folder / f"{row.way}.log"
    arguments = [sys.executable, "-m", "tests.fuzz.child", row.target, row.way, str(folder), f"{seconds:.1f}"]
    with log.open("wb") as stream:
        try:
            code = subprocess.run(
                arguments, stdout=stream, stderr=stream, cwd=ROOT, timeout=seconds + _GRACE_S, check=False
            ).returncode
        except subprocess.TimeoutExpired:
            code = -9
    if (folder / "figures.json").exists():
        row.inputs += json.loads((folder / "figures.json").read_text())["inputs"]
    row.coverage = _coverage(log.read_text(errors="replace"), row.coverage)
    if code and not (folder / "now.bin").exists():
        raise SystemExit(f"{row.target}: did not begin; see {log}")
    if code:
        _keep_killer(folder, code, log)
    return code != 0


def _coverage(log: str, before: list[int]) -> list[int]:
    """Edges that the seeds reached, and that all inputs did; libFuzzer tells them."""
    edges = [int(found) for found in _COVERAGE.findall(log)]
    return [min([*before[:1], edges[0]]), max([*before[1:], *edges])] if edges else before


def _keep_killer(folder: Path, code: int, log: Path) -> None:
    """The input that ended the process, by what ended it."""
    (folder / "crashes").mkdir(exist_ok=True)
    file = folder / "crashes" / f"killed_{abs(code)}.bin"
    shutil.copyfile(folder / "now.bin", file)
    tail = log.read_text(errors="replace")[-2000:]
    file.with_suffix(".txt").write_text(f"process ended with {code}\n{tail}")


def _crashes(folder: Path) -> Iterator[dict[str, str]]:
    for told in sorted((folder / "crashes").glob("*.txt")):
        yield {"key": told.read_text(errors="replace").splitlines()[0], "input": str(told.with_suffix(".bin"))}


def table(rows: list[Row]) -> Iterator[str]:
    """The rows for people."""
    yield f"{'target':<22} {'way':<7} {'inputs':>9} {'a second':>9} {'edges':>12} {'crashes':>8}"
    for row in rows:
        edges = f"{row.coverage[0]}+{row.coverage[1] - row.coverage[0]}" if row.coverage else "-"
        rate = row.inputs / row.seconds if row.seconds else 0.0
        yield f"{row.target:<22} {row.way:<7} {row.inputs:>9} {rate:>9.0f} {edges:>12} {len(row.crashes):>8}"
    crashes = sum(len(row.crashes) for row in rows)
    yield f"{sum(row.inputs for row in rows)} inputs to {len({row.target for row in rows})} targets, {crashes} crashes"


def run(names: list[str], seconds: float, out: Path, jobs: int) -> list[Row]:
    """Fuzz the targets, `jobs` at a time; each has its share of the seconds, however many run beside it."""
    ways = ["bytes", "shaped"] if importlib.util.find_spec("atheris") else ["drawn"]
    if ways == ["drawn"]:
        print("atheris is not installed (pip install -e '.[fuzz]'): hypothesis alone draws inputs", file=sys.stderr)
    share_s = seconds / (len(names) * len(ways))
    with ThreadPoolExecutor(jobs) as pool:
        return [row for rows in pool.map(lambda name: _both_ways(name, ways, share_s, out), names) for row in rows]


def _both_ways(name: str, ways: list[str], share_s: float, out: Path) -> list[Row]:
    shutil.rmtree(out / name, ignore_errors=True)
    rows = [fuzz(name, way, share_s, out) for way in ways]
    for key in sorted({crash["key"] for row in rows for crash in row.crashes}):
        print(f"{name}: {key}", file=sys.stderr)
    return rows


def main() -> int:
    """Fuzz as the command line says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0, help="of fuzzing in all; each process starts in a few")
    parser.add_argument("--target", action="append", choices=list(TARGETS), help="this one (again for more)")
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "fuzz", help="folder for crashes and corpora")
    parser.add_argument("--jobs", type=int, default=1, help="targets at a time")
    parser.add_argument("--json", type=Path, help="write the figures here")
    options = parser.parse_args()
    rows = run(options.target or list(TARGETS), options.seconds, options.out.resolve(), max(1, options.jobs))
    print("\n".join(table(rows)))
    if options.json:
        options.json.write_text(json.dumps([asdict(row) for row in rows], indent=1) + "\n")
    return 1 if any(row.crashes for row in rows) else 0


if __name__ == "__main__":
    sys.exit(main())
