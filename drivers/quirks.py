"""Where real drives differ from CiA 402, as data: one row per maker, each deviation with its source.

The set-up face (drivers/cia402_setup.py) and the master's bring-up act on the fields; `deviations` says for people
what was found and where. `amplifier.quirks` in the configuration names the row; "none" is the standard itself.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum

from servod.cia import Emcy
from servod.errors import BadInput


class Presence(IntEnum):
    """Whether an object exists in a drive."""

    ABSENT = 0  # never touched
    OPTIONAL = 1  # written when it exists, noted when not
    REQUIRED = 2  # the drive does not work in the cyclic modes without it: a refusal ends the bring-up


class AbortReaction(IntEnum):
    """Meanings of 0x6007 (abort connection option code) as the standard numbers them."""

    NOTHING = 0
    FAULT = 1
    DISABLE_VOLTAGE = 2
    QUICK_STOP = 3


@dataclass(frozen=True, slots=True)
class Deviation:
    """One documented difference: what it is, and the manual or issue thread that says so."""

    text: str
    source: str


@dataclass(frozen=True, slots=True)
class Quirks:
    """One row: how to treat a maker's drives where they differ. The defaults are the standard."""

    maker: str
    rated_torque_unit_nm: float = 1e-3  # one count of 0x6076
    abort_connection: dict[AbortReaction, int] = field(default_factory=dict)  # meanings with another number in 0x6007
    abort_connection_presence: Presence = Presence.OPTIONAL
    interpolation_period: Presence = Presence.OPTIONAL  # 0x60C2
    max_pdo_entries: int = 8
    pdo_pairs: int = 4  # RPDOs and TPDOs that exist; all that are not planned are set not valid
    reset_communication_after: frozenset[int] = frozenset()  # EMCY codes that only NMT reset communication clears
    torque_per_rated_current: bool = False  # per mille of 0x6071 refer to rated current, 0x6076 only describes it
    deviations: tuple[Deviation, ...] = ()

    def abort_code(self, reaction: AbortReaction) -> int:
        """What to write to 0x6007 for this reaction."""
        return self.abort_connection.get(reaction, int(reaction))


QUIRKS: dict[str, Quirks] = {
    "none": Quirks(maker="CiA 402"),
}


def load_quirks(name: str) -> Quirks:
    """The row of that name; raises BadInput with the known names."""
    if name not in QUIRKS:
        raise BadInput("amplifier.quirks", name, ", ".join(QUIRKS))
    return QUIRKS[name]


#: Heartbeat loss as an EMCY code, for rows that name it.
HEARTBEAT_LOST = frozenset({int(Emcy.HEARTBEAT_LOST)})
