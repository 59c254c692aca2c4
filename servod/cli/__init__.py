"""`servoctl`: the command line for commissioning. app.py holds the program; every verb has a file of its own."""

import sys


def main() -> None:
    """The program; a Ctrl-C while it is still being loaded ends it as quietly as a later one."""
    try:
        from servod.cli.app import main as program
    except KeyboardInterrupt:
        sys.exit(130)
    program()
