"""Errors for people: the exceptions that end a command, each with its exit code. The table of faults is `faults`.

Stands on nothing. A *fault* is something that happens to a running axis and has a reaction; an *error* ends a command
with one line on standard error and an exit code (0 done, 1 the answer is no, 2 bad input, 3 unreachable).
"""

from __future__ import annotations

from typing import Any, NamedTuple

#: Longest part of a message; what stood in a file may be of any length.
_MOST_SHOWN = 600


class ServodError(Exception):
    """Base of all errors that a command reports in one line; `exit_code` is what the process returns."""

    exit_code = 1

    def __reduce__(self) -> tuple[Any, ...]:
        """As it is, whatever its parts were: an error that cannot be read on its way from a worker process to its
        parent looks as if the worker had died."""
        return _as_it_was, (type(self), self.args, self.__dict__)


def _as_it_was(kind: type[ServodError], args: tuple[Any, ...], parts: dict[str, Any]) -> ServodError:
    error = kind.__new__(kind, *args)
    error.__dict__.update(parts)
    return error


class AnswerIsNo(ServodError):
    """The work ran and its answer is "no": verification failed, limits violated."""

    exit_code = 1


class BadInput(ServodError):
    """Bad usage or bad input; says where it stands, what was found and what is allowed.

    `where` names the file, and the key or column when there is one ("axis.yaml: amplifier.node_id").
    """

    exit_code = 2

    def __init__(self, where: str, found: object, allowed: str) -> None:
        self.where, self.found, self.allowed = where, found, allowed
        super().__init__(f"{one_line(where)}: found {one_line(found)}; allowed: {one_line(allowed)}")


class Details(NamedTuple):
    """Where an error stands, what was found there and what is allowed; None where that is not known."""

    where: str | None = None
    found: str | None = None
    allowed: str | None = None


def details(error: BaseException) -> Details:
    """The parts of an error's line, each in one line of its own: what `--json` and the control socket tell of it."""
    if not isinstance(error, BadInput):
        return Details()
    return Details(*(one_line(part) or None for part in (error.where, error.found, error.allowed)))


def one_line(part: object) -> str:
    """A part of a message that may come from outside: of bounded length, with nothing that acts on a terminal."""
    text = " ".join(str(part).split())
    if len(text) > _MOST_SHOWN:
        text = f"{text[: _MOST_SHOWN - 80]} ... {text[-70:]}"
    return visible(text)


def visible(text: str) -> str:
    """`text` with a sign for every character but the end of a line that has none: what acts on a terminal, turns the
    direction of what stands beside it, or comes from a file name that is no UTF-8."""
    return "".join(c if c.isprintable() or c == "\n" else c.encode("unicode_escape").decode() for c in text)


class Unreachable(ServodError):
    """A device, bus or daemon cannot be reached, or refused."""

    exit_code = 3
