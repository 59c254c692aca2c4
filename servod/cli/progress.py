"""One progress bar over a whole command, on standard error, so that standard output stays what was asked for."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

#: Told what is being done, and the share of the whole that is done.
Tell = Callable[[str, float], None]


@contextmanager
def progress(name: str, quiet: bool) -> Iterator[Tell]:
    """A bar that says what is being done; nothing when quiet."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description:28}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), disable=quiet, transient=True) as bars:
        task = bars.add_task(name, total=1.0)
        yield lambda what, share: bars.update(task, description=what, completed=share)
