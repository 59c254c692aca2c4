"""`python -m servod.cli` is `servoctl`."""

from servod.cli.app import main

main()
