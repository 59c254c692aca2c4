"""What the cycle faces make of a PDO's plan, once at start: its struct, the places of its objects, its longest silence.

Used by cia402 and cia406, so that what they decode is what the plan maps, in its order and lengths; in the cycle one
`unpack_from` reads the whole frame.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Mapping

from servod.common.errors import BadInput
from servod.runtime.fieldbus.devices import LAST_SYNCHRONOUS_TYPE, NodePlan, PdoMap

#: How many event timers a PDO may stay away, and the cycles on top for the jitter of bus and loop.
_EVENT_TIMERS, _MARGIN_CYCLES = 3, 10
_SLOW_US = 10_000


def slow_syncs(period_us: int) -> int:
    """With every how many-th SYNC comes what need not come with each: some 10 ms.

    At least four: a node that answers a cycle late must not look like two (servod.runtime.loop.answers).
    """
    return min(max(_SLOW_US // period_us, 4), LAST_SYNCHRONOUS_TYPE)


def lost_after_cycles(pdo: PdoMap | None, period_s: float) -> int | None:
    """Cycles without this PDO after which what it said is not known any more; None when it has no event timer.

    Its event timer counts for one that comes with SYNC, too, which is sooner: what a stall holds up must not disable a
    joint that the loop still brakes.
    """
    if pdo is None or not pdo.event_timer_ms:
        return None
    return math.ceil(_EVENT_TIMERS * pdo.event_timer_ms * 1e-3 / period_s) + _MARGIN_CYCLES


def codec(pdo: PdoMap, formats: Mapping[int, str], driver: str) -> struct.Struct:
    """Struct of the PDO's data; `formats` gives the struct letter of each known index. Raises BadInput for others.

    The letter must be as long as the mapped length: a 32-bit mapping of a 16-bit object would shift all that follows.
    """
    letters = []
    for entry in pdo.entries:
        letter = formats.get(entry.index)
        if letter is None or 8 * struct.calcsize("<" + letter) != entry.bits:
            known = ", ".join(f"0x{i:04X}:{8 * struct.calcsize('<' + f)}" for i, f in formats.items())
            raise BadInput(f"mapping of driver {driver}", f"0x{entry.index:04X}:{entry.bits}", f"one of {known}")
        letters.append(letter)
    return struct.Struct("<" + "".join(letters))


def slot(pdo: PdoMap, index: int) -> int:
    """Place of object `index` in the unpacked tuple; raises BadInput when the PDO does not map it."""
    for place, entry in enumerate(pdo.entries):
        if entry.index == index:
            return place
    mapped = ", ".join(f"0x{e.index:04X}" for e in pdo.entries)
    raise BadInput(f"mapping of PDO 0x{pdo.cob_id:03X}", mapped, f"a mapping with 0x{index:04X}")


def find(plan: NodePlan, receive: bool, indices: Iterable[int]) -> PdoMap:
    """The PDO of the plan that maps all `indices`; raises BadInput when there is none."""
    wanted = set(indices)
    for pdo in plan.pdos:
        if pdo.receive is receive and wanted <= {e.index for e in pdo.entries}:
            return pdo
    names = ", ".join(f"0x{i:04X}" for i in sorted(wanted))
    raise BadInput(f"mapping of node {plan.node_id}", "no such PDO", f"one {'R' if receive else 'T'}PDO with {names}")
