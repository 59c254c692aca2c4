"""`servoctl`: the command line for commissioning. app.py holds the program; every verb has a file of its own."""

from servod.cli.app import main

__all__ = ["main"]
