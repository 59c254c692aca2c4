"""The schedule of a soak, drawn from a seed: what the axis does, what befalls it meanwhile, and how it goes on.

Stands on the table of kinds alone; the same seed gives the same schedule on every machine.
"""

from __future__ import annotations

import math
import random
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum

from servod.qualify.faults.scenario import Scenario
from servod.qualify.soak.kinds import KINDS, InjectionKind
from servod.runtime.loop.commands import ReferenceKind

#: Share of the episodes in which something goes wrong.
_FAULT_SHARE = 0.7
#: Share of these in which it goes wrong while the wiring is tested, and how long a proof takes [s].
_PROVING_SHARE, _PROOF_S = 0.15, 0.42
#: The fastest reference [rad/s] and the largest amplitude [rad]: what the demo joint's torque can follow.
_FASTEST_RAD_S, _LARGEST_RAD = 1.2, 0.3
_SAMPLES_PER_S = 1000


class SoakEnding(StrEnum):
    """How an episode whose motion still runs goes on."""

    FINISH = "the motion comes to its end"
    HALT = "halt, and on again"
    DISABLE = "disable under way, enable"
    QUICK_STOP = "quick stop, enable"


@dataclass(frozen=True)
class Move:
    """One motion: Op.REFERENCE's kind and arguments; `table` fills the trajectory area first."""

    kind: ReferenceKind
    arguments: tuple[float, ...]
    duration_s: float
    table: tuple[float, ...] = ()


@dataclass(frozen=True)
class Episode:
    """One piece of a soak: `law` is a gain set to change to, None keeps what acts; the fault comes `before_s` into the
    motion, or, with `proves`, into a wiring test in its place."""

    number: int
    law: str | None
    move: Move
    before_s: float
    fault: InjectionKind | None
    ending: SoakEnding
    seed: int
    proves: bool = False


def schedule(seed: int, gain_sets: tuple[str, ...], kinds: tuple[InjectionKind, ...] = KINDS) -> Iterator[Episode]:
    """Episodes without end. Each kind of fault comes once before any comes again."""
    chance = random.Random(seed)  # noqa: S311  (a schedule, not a secret)
    waiting: list[InjectionKind] = []
    number = 0
    while True:
        number += 1
        fault = None
        if chance.random() < _FAULT_SHARE:
            if not waiting:
                waiting = chance.sample(kinds, len(kinds))
            fault = waiting.pop()
        move = _MOVES[chance.choice(tuple(_MOVES))](chance)
        law = chance.choice(gain_sets) if chance.random() < 0.3 else None
        proves = fault is not None and not fault.of_control and chance.random() < _PROVING_SHARE
        before_s = chance.uniform(0.02, 0.9) * (_PROOF_S if proves else min(move.duration_s, 1.5))
        yield Episode(
            number, law, move, before_s, fault, chance.choice(tuple(SoakEnding)), chance.getrandbits(32), proves
        )


def home(from_rad: float) -> Move:
    """Back to zero along half a cosine."""
    duration_s = max(0.5, 2.0 * abs(from_rad))
    count = round(duration_s * _SAMPLES_PER_S) + 1
    way = tuple(0.5 * from_rad * (1.0 + math.cos(math.pi * k / (count - 1))) for k in range(count))
    return Move(ReferenceKind.TABLE, (count, min(way), max(way)), duration_s, way)


def _sine(chance: random.Random) -> Move:
    frequency_hz, duration_s = chance.uniform(0.2, 3.0), chance.uniform(0.5, 3.0)
    amplitude_rad = min(_LARGEST_RAD, _FASTEST_RAD_S / (2.0 * math.pi * frequency_hz)) * chance.uniform(0.1, 1.0)
    return Move(ReferenceKind.SINE, (amplitude_rad, frequency_hz, duration_s), duration_s)


def _paper(chance: random.Random) -> Move:
    duration_s = chance.uniform(0.5, 5.0)
    return Move(ReferenceKind.PAPER, (duration_s,), duration_s)


def _step(chance: random.Random) -> Move:
    duration_s = chance.uniform(0.2, 1.0)
    return Move(ReferenceKind.STEP, (chance.uniform(-0.1, 0.1), duration_s), duration_s)


def _table(chance: random.Random) -> Move:
    """There and back again over a bump."""
    duration_s, height_rad = chance.uniform(0.8, 2.0), chance.uniform(-0.3, 0.3)
    count = round(duration_s * _SAMPLES_PER_S) + 1
    way = tuple(0.5 * height_rad * (1.0 - math.cos(2.0 * math.pi * k / (count - 1))) for k in range(count))
    return Move(ReferenceKind.TABLE, (count, min(way), max(way)), duration_s, way)


def _excite(chance: random.Random) -> Move:
    """A bump with small random torques on top, as the identification puts them to the axis."""
    bump = _table(chance)
    level_nm = chance.uniform(0.001, 0.01)
    torques = tuple(chance.choice((-level_nm, level_nm)) for _ in bump.table)
    return Move(ReferenceKind.EXCITE, (*bump.arguments, 0.3), bump.duration_s, bump.table + torques)


def _hold(chance: random.Random) -> Move:
    return Move(ReferenceKind.HOLD, (), chance.uniform(0.1, 1.0))


_MOVES = {
    ReferenceKind.SINE: _sine,
    ReferenceKind.PAPER: _paper,
    ReferenceKind.STEP: _step,
    ReferenceKind.TABLE: _table,
    ReferenceKind.EXCITE: _excite,
    ReferenceKind.HOLD: _hold,
}


# --- The axis --------------------------------------------------------------------------------------------------------
# The axis that a soak begins with: what ships, with noise of its own.


def nothing_yet(seed: int, proves: bool) -> Scenario:
    """The campaign's axis as it ships, with noise from `seed`; what a scenario injects is not used.

    `proves`: it proves its wiring after every start, as it ships; a scenario's axis does not.
    """
    return Scenario.model_validate(
        {
            "title": "soak",
            "why": "Trust grows with hours.",
            "group": "soak",
            "settings": {"seed": seed},
            "config": {"wiring_proof": {"enabled": proves}},
            "inject": [{"do": {"frames": {"of": "any", "fault": "drop"}}}],
            "expect": {"axis": ["ENABLED"]},
        }
    )
