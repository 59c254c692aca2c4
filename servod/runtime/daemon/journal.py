"""Log lines for the journal: to standard error, with systemd's level prefix where the journal reads it."""

from __future__ import annotations

import logging
import os
import sys

#: sd-daemon(3): "<N>" at the start of a line is its syslog priority.
_PRIORITY = {logging.DEBUG: 7, logging.INFO: 6, logging.WARNING: 4, logging.ERROR: 3, logging.CRITICAL: 2}


def harmless(text: str) -> str:
    """`text` in one line, whatever stands in it: nothing that begins a new entry, or acts on the reader's terminal."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in " ".join(text.splitlines()))


class _JournalFormatter(logging.Formatter):
    """One line per message, whatever is in it."""

    def __init__(self, to_journal: bool) -> None:
        super().__init__("%(message)s" if to_journal else "%(asctime)s %(levelname)s %(message)s")
        self._to_journal = to_journal

    def format(self, record: logging.LogRecord) -> str:
        """The line, its priority in front when the journal reads it."""
        line = harmless(super().format(record))
        return f"<{_PRIORITY.get(record.levelno, 6)}>{line}" if self._to_journal else line


def print_error(text: str) -> None:
    """The one line that ends a program, on standard error."""
    prefix = f"<{_PRIORITY[logging.ERROR]}>" if "JOURNAL_STREAM" in os.environ else ""
    print(f"{prefix}servod: {harmless(' '.join(text.split()))}", file=sys.stderr, flush=True)


def set_up_logging() -> None:
    """Send the daemon's log lines to standard error; libraries speak from WARNING on."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_JournalFormatter("JOURNAL_STREAM" in os.environ))
    logging.basicConfig(level=logging.WARNING, handlers=[handler], force=True)
    logging.getLogger("servod").setLevel(logging.INFO)
