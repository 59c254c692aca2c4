"""Runs `servoctl diagnose` on every case folder, as a user would: a process each, in a copy of this folder alone.

The second of the three processes. What is done is not done again, so that an interrupted trial goes on where it was;
but a trial is of one diagnosis, so that answers of other sources are no part of it.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Lock

from servod.common.errors import BadInput
from servod.common.files import read_bytes, read_json, unwritable, write_bytes
from servod.common.sources import DIAGNOSES, sha256_on_disk
from servod.qualify.blind.conceal import CASES, lock

#: Told the case that was diagnosed last, how many are done and how many there are.
OnProgress = Callable[[str, int, int], None]

ANSWERS, RUN, DIAGNOSIS, MODEL, SAID = "answers", "run.json", "diagnosis.json", "model.yaml", "said.txt"


@dataclass(frozen=True)
class DiagnosisRun:
    """How one diagnosis went: exit code, seconds of wall clock and of all cores, its largest memory, its time limit.

    `sources` is the hash of the diagnosis that answered.
    """

    exit_code: int
    wall_s: float
    cpu_s: float
    memory_mib: float
    time_limit_s: float
    sources: str


class Examiner:
    """Diagnoses the cases of a trial, some at a time."""

    def __init__(self, out: Path, time_limit_s: float) -> None:
        self._out, self._time_limit_s = out, time_limit_s
        self._running: set[subprocess.Popen[bytes]] = set()
        self._lock = Lock()
        self._ended = False
        self._sources = sha256_on_disk(DIAGNOSES)

    def run(self, jobs: int, on_progress: OnProgress) -> None:
        """Diagnose all cases that have no answer. An interrupt ends what runs and keeps what is done.

        Raises BadInput when what is done was done by other sources, or when the sources change meanwhile.
        """
        lock(self._out)
        names = sorted(folder.name for folder in (self._out / CASES).iterdir())
        answered = [name for name in names if (self._out / ANSWERS / name / RUN).exists()]
        one_diagnosis(self._out, answered, self._sources)
        open_cases, done = sorted(set(names) - set(answered)), len(answered)
        with self._workers(jobs) as pool:
            pending: dict[Future[None], str] = {pool.submit(self._examine, name): name for name in open_cases}
            for job in as_completed(pending):
                job.result()
                done += 1
                on_progress(pending[job], done, len(names))

    @contextmanager
    def _workers(self, jobs: int) -> Iterator[ThreadPoolExecutor]:
        """Threads that wait for processes; whatever ends the block ends these."""
        pool = ThreadPoolExecutor(jobs)
        try:
            yield pool
        finally:
            with self._lock:
                self._ended = True
                for process in self._running:
                    process.terminate()
            pool.shutdown(cancel_futures=True)

    def _examine(self, name: str) -> None:
        """Diagnose a copy of a case in a folder where there is nothing else, then fetch the answer."""
        answers = self._out / ANSWERS / name
        try:
            self._answer(name, answers)
        except (OSError, BadInput) as error:
            shutil.rmtree(answers, ignore_errors=True)  # half of it, on a full disk
            with suppress(OSError):  # others have an answer
                answers.parent.rmdir()
            if isinstance(error, OSError):
                raise unwritable(error.filename or answers, error) from None
            raise

    def _answer(self, name: str, answers: Path) -> None:
        answers.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(prefix="servod-case-") as alone, (answers / SAID).open("wb") as said:
            case, answer = Path(alone) / "case", Path(alone) / "answer"
            _copy(self._out / CASES / name, case)
            recordings = sorted(str(path) for path in case.glob("*.csv.gz"))
            arguments = ["diagnose", "--model", str(case / MODEL), *recordings, "--out", str(answer)]
            limit = f"--time-limit={self._time_limit_s:g}"
            run = self._spend([sys.executable, "-m", "servod.cli", *arguments, limit], case, said.fileno())
            if run is not None:
                _unchanged(sha256_on_disk(DIAGNOSES), self._sources)
                if answer.is_dir():  # a diagnosis that was refused leaves none
                    _copy(answer, answers)
                write_bytes(answers / RUN, (json.dumps(asdict(run)) + "\n").encode())

    def _spend(self, command: Sequence[str], where: Path, said: int) -> DiagnosisRun | None:
        """Run a command to its end; None when we were told to stop meanwhile."""
        begun = time.monotonic()
        with self._lock:
            if self._ended:
                return None
            process = subprocess.Popen(command, cwd=where, stdin=subprocess.DEVNULL, stdout=said, stderr=said)
            self._running.add(process)
        _, status, used = os.wait4(process.pid, 0)
        with self._lock:
            self._running.discard(process)
            process.returncode = os.waitstatus_to_exitcode(status)
            if self._ended:
                return None
        cpu_s = used.ru_utime + used.ru_stime
        wall_s, memory_mib = time.monotonic() - begun, used.ru_maxrss / 1024.0
        return DiagnosisRun(process.returncode, wall_s, cpu_s, memory_mib, self._time_limit_s, self._sources)


def _copy(folder: Path, target: Path) -> None:
    """Copy the files of a folder, and of those in it, into another. Raises BadInput, which names the file."""
    for file in sorted(path for path in folder.rglob("*") if path.is_file()):
        write_bytes(target / file.relative_to(folder), read_bytes(file))


def one_diagnosis(out: Path, names: Sequence[str], sources: str | None = None) -> str | None:
    """Hash of the sources that all these answers come from, `sources` when given; None when there is no answer.

    Raises BadInput when they differ: a figure over answers of two diagnoses is of neither.
    """
    for name in names:
        path = out / ANSWERS / name / RUN
        found = read_json(path, "what `servoctl prove` wrote").get("sources", "unknown")
        if sources not in (None, found):
            raise BadInput(
                str(path),
                f"an answer of sources {found[:12]}",
                f"sources {sources[:12]} as the others have; remove {out / ANSWERS} to diagnose all cases again",
            )
        sources = found
    return sources


def _unchanged(now: str, begun: str) -> None:
    """Refuse an answer that came while somebody edited the diagnosis."""
    if now != begun:
        raise BadInput("the sources of servod", f"changed from {begun[:12]} to {now[:12]}", "the same to the end")
