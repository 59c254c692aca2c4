"""Recordings that are one and the same: nothing may be judged by rows that it was fitted to.

Stands beside the recordings, before whoever fits them and is judged by them. A copy has another name, often another
clock, sometimes fewer digits or only a part of the rows; two runs of one motion have the same goal and differ in what
was measured. So short sequences of rows are compared by everything that both have but the time, where the axis moves.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from servod.common.errors import BadInput
from servod.lab.recordings.columns import Quantity
from servod.lab.recordings.recording import Recording

Words = NDArray[np.uint64]

#: Rows of a sequence, and positions in it at least: a joint at rest is like any other at rest.
ROWS, POSITIONS = 8, 3

#: Decimal places behind the largest value's that are compared.
PLACES = 5

#: Share of the shorter recording's sequences in the other from which they are one.
SAME = 0.5


def need_distinct(fitted: Sequence[Recording], held_out: Sequence[Recording] = ()) -> None:
    """See that every recording counts once, and that none that is held out is in a fit. Raises BadInput."""
    for one, other in combinations(fitted, 2):
        if are_same(one, other):
            raise BadInput(str(other.path), f"the rows of {one.path} again", "each recording once")
    for one in held_out:
        for other in fitted:
            if are_same(one, other):
                raise BadInput(f"--hold-out {one.path}", f"rows of {other.path}", "a recording that no fit sees")
    for one, other in combinations(held_out, 2):
        if are_same(one, other):
            raise BadInput(f"--hold-out {other.path}", f"the rows of {one.path} again", "each recording once")


def are_same(one: Recording, other: Recording) -> bool:
    """Whether one recording is the other, or a part of it."""
    common = [quantity for quantity in one.columns if quantity in other.columns and quantity is not Quantity.TIME]
    mine, its = map(partial(_sequences, quantities=common), (one, other))
    shorter, longer = (mine, its) if len(mine) <= len(its) else (its, mine)
    return len(shorter) > 0 and float(np.mean(np.isin(shorter, longer))) > SAME


def _sequences(recording: Recording, quantities: Sequence[Quantity]) -> Words:
    """A number for every sequence of rows in motion, by all values of these quantities in it."""
    if len(recording) < ROWS:
        return np.zeros(0, dtype=np.uint64)
    rows = np.zeros(len(recording), dtype=np.uint64)
    for quantity in quantities:
        rows = _mixed(rows, _rounded(recording.columns[quantity]))
    windows = np.lib.stride_tricks.sliding_window_view(rows, ROWS)
    found = np.zeros(len(windows), dtype=np.uint64)
    for row in range(ROWS):
        found = _mixed(found, windows[:, row])
    changes = np.diff(recording.position) != 0.0
    moves = np.lib.stride_tricks.sliding_window_view(changes, ROWS - 1).sum(axis=1) >= POSITIONS - 1
    return np.asarray(found[moves])


def _rounded(values: NDArray[np.float64]) -> Words:
    """Values to so many places, as whole numbers; missing ones are 0."""
    known = np.nan_to_num(values)
    largest = float(np.max(np.abs(known)))
    unit = 10.0 ** (np.ceil(np.log10(largest)) - PLACES) if largest > 0.0 else 1.0
    return np.round(known / unit).astype(np.int64).view(np.uint64)


def _mixed(seed: Words, values: Words) -> Words:
    """Two columns of words mixed into one (the finaliser of splitmix64: Steele, Lea, Flood, OOPSLA 2014)."""
    mixed = seed * np.uint64(31) + values + np.uint64(0x9E3779B97F4A7C15)
    mixed = (mixed ^ (mixed >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.asarray(mixed ^ (mixed >> np.uint64(31)))
