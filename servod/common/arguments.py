"""Arguments of the programs that are no `servoctl`: what is wrong with them comes as every other bad input does."""

from __future__ import annotations

import argparse
from typing import NoReturn

from servod.common.errors import BadInput


class ArgumentParser(argparse.ArgumentParser):
    """argparse's, whose complaints raise BadInput, and so are one line."""

    def error(self, message: str) -> NoReturn:
        """What argparse found."""
        raise BadInput("arguments", message, f"see `{self.prog} --help`")
