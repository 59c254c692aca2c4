"""The program `servod --config axis.yaml`: arguments, signals, exit codes. Started by systemd, or by hand to try it."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import NoReturn

from servod import __version__
from servod.common.end_signals import on_end_signals
from servod.common.errors import BadInput, ServodError
from servod.runtime.daemon.journal import print_error, set_up_logging
from servod.runtime.daemon.startup import check, run
from servod.runtime.daemon.supervisor import Supervisor

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
