"""How an effect is looked at: the coordinate of its picture, and what splits its rows.

Stands under the effects' files, and so under what is drawn and said of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class Split(Enum):
    """How rows are told apart in a signature, so that opposite signs do not cancel."""

    NONE = "none"
    DIRECTION = "direction"
    LOAD = "load"


@dataclass(frozen=True)
class Look:
    """The coordinate (a name of `coordinates`) over which an effect is looked at, and what splits its rows."""

    coordinate: str
    split: Split = Split.NONE
    periodic: bool = False
