"""`python -m servod.cli` is `servoctl`."""

from servod.cli import main

main()
