"""Judges what a target does with one input: only servod's own errors, in one short line, in bounded time and memory."""

from __future__ import annotations

import contextlib
import resource
import signal
import traceback
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from servod.common.errors import ServodError
from tests.fuzz.target import Target

#: Processor seconds that one input may take; the shared machine's clock tells nothing.
MOST_CPU_S = 8.0
#: Address space that inputs may take beyond what the process has after its imports; Arrow alone reserves a third.
MOST_BYTES = 3 * 1024 * 1024 * 1024
#: Longest line for people.
MOST_MESSAGE = 2000

#: Words of Python, which say nothing to people.
PYTHON_WORDS = ("NoneType", "Traceback", "<class", "object at 0x", "Errno", "with base", "Error:", "object has no")

ROOT = Path(__file__).resolve().parents[2]


class TooSlowError(BaseException):
    """The input took too much processor time; no `except Exception` swallows it."""


class BadMessageError(Exception):
    """A documented error whose message is not one short, printable line."""


class Crash(NamedTuple):
    """What went wrong: `key` is the same for the same fault, `text` tells it with its traceback."""

    key: str
    text: str


def judge(target: Target, data: bytes) -> Crash | None:
    """Hand `data` in; None when all is well."""
    try:
        with _bounded_time(), warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)  # numpy's: a user would see them on standard error
            _documented(target, data)
    except (Exception, TooSlowError) as error:
        return Crash(_key(error), "".join(traceback.format_exception(error)))
    return None


def _documented(target: Target, data: bytes) -> None:
    try:
        target.run(data)
    except ServodError as error:
        line = str(error)
        if len(line) > MOST_MESSAGE or not line.isprintable() or any(word in line for word in PYTHON_WORDS):
            raise BadMessageError(f"{len(line)} characters: {line[:300]!r}") from error


@contextlib.contextmanager
def _bounded_time() -> Iterator[None]:
    before = signal.signal(signal.SIGVTALRM, _too_slow)
    signal.setitimer(signal.ITIMER_VIRTUAL, MOST_CPU_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
        signal.signal(signal.SIGVTALRM, before)


def _too_slow(*_: Any) -> None:
    raise TooSlowError(f"over {MOST_CPU_S:g} s of processor time")


def _key(error: BaseException) -> str:
    """Kind of the error and the last place in the project's own code that it came through."""
    if isinstance(error, BadMessageError) and error.__cause__ is not None:
        return f"BadMessage {_place(error.__cause__)}"
    return f"{type(error).__name__} {_place(error)}"


def _place(error: BaseException) -> str:
    frames = traceback.extract_tb(error.__traceback__)
    own = [f for f in frames if Path(f.filename).is_relative_to(ROOT) and "tests/fuzz" not in f.filename]
    last = (own or frames)[-1]
    return f"{Path(last.filename).name}:{last.name}"


def bound_memory() -> None:
    """Let this process take no more than MOST_BYTES beyond what it has now, and write no large files or cores."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * resource.getpagesize() + MOST_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 28, 1 << 28))
