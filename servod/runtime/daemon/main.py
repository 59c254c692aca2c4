"""The program `servod --config axis.yaml`: arguments, signals, exit codes. Started by systemd, or by hand to try it."""

from __future__ import annotations

import argparse
import logging
import os
import sys
from pathlib import Path
from typing import NoReturn

from servod import __version__
from servod.common.errors import BadInput, ServodError
from servod.common.workers import on_end_signals
from servod.runtime.daemon.startup import check, run
from servod.runtime.daemon.supervisor import Supervisor

# Log lines for the journal: to standard error, with systemd's level prefix where the journal reads it.


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


_EXAMPLE = """\
example:
  servod --config /etc/servod/config/can0.yaml          run the axis until SIGTERM
  servod --config /etc/servod/config/can0.yaml --check  only check the configuration and the files it names

exit codes: 0 done, 2 bad usage or input, 3 bus, device or loop cannot be reached or was lost
"""


class _Parser(argparse.ArgumentParser):
    """Says what is wrong with the arguments in one line."""

    def error(self, message: str) -> NoReturn:
        raise BadInput("arguments", message, "see `servod --help`")


def _parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = _Parser(
        prog="servod",
        description="Runs one servo axis over CANopen: 1 kHz friction-compensating control, supervised and recorded.",
        epilog=_EXAMPLE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--config", type=Path, required=True, metavar="FILE", help="axis configuration (YAML)")
    parser.add_argument("--check", action="store_true", help="check the configuration and end")
    parser.add_argument("--version", action="version", version=f"servod {__version__}")
    return parser.parse_args(arguments)


def _end_start_on_signals() -> None:
    """Until the supervisor takes over, they are as Ctrl-C: what was begun is undone."""
    on_end_signals(_interrupt)


def _interrupt() -> None:
    raise KeyboardInterrupt


def _stop_on_signals(supervisor: Supervisor) -> None:
    on_end_signals(supervisor.request_stop)


def main(arguments: list[str] | None = None) -> int:
    """Run the daemon; returns the exit code, with one line on standard error when it is not 0."""
    set_up_logging()
    try:
        options = _parse(arguments)
        if options.check:
            config = check(options.config)
            print(f"{options.config}: good; axis {config.name} on {config.bus.interface} {config.bus.channel}")
            return 0
        _end_start_on_signals()
        return run(options.config, _stop_on_signals)
    except ServodError as error:
        print_error(str(error))
        return error.exit_code
    except KeyboardInterrupt:
        return 130


if __name__ == "__main__":
    sys.exit(main())
