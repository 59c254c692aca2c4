"""Starts what `servoctl soak` was asked for: one axis in this process, or several in processes of their own."""

from __future__ import annotations

import json
import math
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import closing, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from servod.client.processes import sigterm_as_interrupt
from servod.common.errors import Unreachable
from servod.qualify.soak.document import added
from servod.qualify.soak.kinds import KINDS
from servod.qualify.soak.page import write_page
from servod.qualify.soak.plan import schedule
from servod.qualify.soak.run import DOCUMENT_NAME, Tell, run, save
from servod.qualify.soak.stepped import GAIN_SETS, SteppedSoak
from servod.qualify.soak.wall import WallSoak, of_the_wall

_POLL_S, _CYCLES_PER_S = 1.0, 1000.0
#: After Ctrl-C a job ends its episode's check and writes its document.
_PATIENCE_S = 60.0


class Order(NamedTuple):
    """What was asked for. `limit_hours`: wall clock, None for as long as it takes."""

    cycles: int
    seed: int
    wall: bool
    limit_hours: float | None
    out: Path


def launch(order: Order, jobs: int, tell: Tell) -> dict[str, Any]:
    """Soak, and write document and page to `order.out`."""
    with sigterm_as_interrupt():
        found = _single(order, tell) if jobs == 1 else _several(order, jobs, tell)
        found |= {"mode": "wall" if order.wall else "stepped", "seeds": list(range(order.seed, order.seed + jobs))}
    save(found, order.out)
    write_page(found, order.out)
    return found


def _single(order: Order, tell: Tell) -> dict[str, Any]:
    limit_s = math.inf if order.limit_hours is None else order.limit_hours * 3600.0
    if order.wall:
        return _wall(order, limit_s, tell)
    with closing(SteppedSoak(order.seed, order.out)) as axis:
        return run(axis, schedule(order.seed, GAIN_SETS), order.cycles, limit_s, order.out, tell)


def _wall(order: Order, limit_s: float, tell: Tell) -> dict[str, Any]:
    """Cycles take their time on the wall clock; sockets want a short path."""
    kinds = tuple(filter(of_the_wall, KINDS))
    limit_s = min(limit_s, order.cycles / _CYCLES_PER_S)
    with TemporaryDirectory(prefix="servod-soak-") as folder, closing(WallSoak(order.seed, Path(folder))) as axis:
        return run(axis, schedule(order.seed, GAIN_SETS, kinds), sys.maxsize, limit_s, order.out, tell)


def _several(order: Order, jobs: int, tell: Tell) -> dict[str, Any]:
    """The same command in processes of their own, with seeds of their own; Ctrl-C is passed on."""
    folders = [order.out / str(order.seed + job) for job in range(jobs)]
    processes = [_start(order._replace(seed=order.seed + job, out=folder)) for job, folder in enumerate(folders)]
    try:
        while any(process.poll() is None for process in processes):
            time.sleep(_POLL_S)
            _tell(folders, order.cycles, tell)
    except KeyboardInterrupt:
        for process in processes:
            process.send_signal(signal.SIGTERM)
    exit_codes = [_ended(process) for process in processes]
    return added([_read(folder) for folder in folders], exit_codes)


def _ended(process: subprocess.Popen[bytes]) -> int:
    """The exit code of a job; one that does not come to its end is killed."""
    try:
        return process.wait(_PATIENCE_S)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()


def _start(order: Order) -> subprocess.Popen[bytes]:
    (order.out / DOCUMENT_NAME).unlink(missing_ok=True)
    command = ["soak", "--json", "--cycles", str(order.cycles), "--seed", str(order.seed), "--out", str(order.out)]
    if order.limit_hours is not None:
        command += ["--limit-hours", str(order.limit_hours)]
    return subprocess.Popen(
        [sys.executable, "-m", "servod.cli", *command],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        start_new_session=True,
    )


def _tell(folders: Sequence[Path], cycles: int, tell: Tell) -> None:
    with suppress(Unreachable):
        found = added([_read(folder) for folder in folders])
        share = found["cycles"] / cycles / len(folders)
        tell(f"{found['cycles'] / 1e6:.2f} M cycles, {sum(found['wrong'].values())} wrong", share)


def _read(folder: Path) -> dict[str, Any]:
    """The document of a job. Raises Unreachable when it has not written one."""
    try:
        found: dict[str, Any] = json.loads((folder / DOCUMENT_NAME).read_text())
    except OSError as error:
        raise Unreachable(f"{folder}: the job left no {DOCUMENT_NAME} ({error.strerror})") from None
    return found
