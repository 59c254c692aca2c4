"""Control laws: plain functions on floats, called by the loop as they are and compiled by the simulator.

Step (4) of the cycle. `LAWS` is the one table of laws; the numbers are stable, gain sets and the loop's ACTIVATE
command carry them. What crosses a border (gain set, command) is a flat sequence of numbers; `Law.named` gives them the
names by which the kernels read them. `runtime.loop.controller.Controller` is what the loop holds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

from servod.kernels.laws import local, pd, pd_dob, pd_lugre, position, weights
from servod.kernels.laws.state import LawState

#: step(p, s, x_ref, v_ref, a_ref, x, v, u_applied, dt) -> (torque, feedback, friction, other), SI units; every law has
#: numbers `p` of its own kind, what its `Law.named` gives.
Step = Callable[
    [Any, LawState, float, float, float, float, float, float, float],
    tuple[float, float, float, float],
]

#: Most local sets of one gain set; keeps the ACTIVATE command bounded.
MAX_SETS = 64
#: Most parameters that any law has, for the size of the command slot between supervisor and loop.
MAX_PARAMETERS = local.FIRST_NODE + 3 * MAX_SETS + position.MAX_SIZE


class LawNumber(IntEnum):
    """Stable numbers of the laws."""

    PD = 1
    PD_DOB = 2
    PD_LUGRE = 3
    LOCAL = 4


@dataclass(frozen=True, slots=True)
class Law:
    """One row of the table of laws.

    `named` gives names to flat numbers that it `accepts`: the NamedTuple that `step` reads. `n_parameters` is how many
    numbers there are; for `local` without its sets (three floats each) and what is known of position.
    `has_friction_state` says that z_hat means something, times the number `stiffness` a torque; the controller uses it
    to carry the friction *torque* over when two laws scale their state differently.
    """

    name: str
    number: LawNumber
    step: Step
    named: Callable[[Sequence[float]], Any]
    n_parameters: int
    has_friction_state: bool = False

    def accepts(self, parameters: Sequence[float]) -> bool:
        """Whether `parameters` has the length that this law reads, so that no name can be missing inside the cycle."""
        if self.number is not LawNumber.LOCAL:
            return len(parameters) == self.n_parameters
        if len(parameters) <= local.N_SETS:
            return False
        n = parameters[local.N_SETS]
        return 2 <= n <= MAX_SETS and position.fits(len(parameters) - self.n_parameters - 3 * int(n))


def _row(name: str, number: LawNumber, step: Step, gains: Any, *, has_friction_state: bool = False) -> Law:
    """The row of a law whose numbers are all in `gains`, one behind the other."""
    return Law(name, number, step, gains._make, len(gains._fields), has_friction_state)


LAWS: dict[str, Law] = {
    law.name: law
    for law in (
        _row("pd", LawNumber.PD, pd.step, pd.PdGains),
        _row("pd_dob", LawNumber.PD_DOB, pd_dob.step, pd_dob.PdDobGains),
        _row("pd_lugre", LawNumber.PD_LUGRE, pd_lugre.step, pd_lugre.PdLugreGains, has_friction_state=True),
        Law("local", LawNumber.LOCAL, local.step, local.LocalGains.from_flat, local.FIRST_NODE, True),
    )
}

LAW_BY_NUMBER: dict[int, Law] = {int(law.number): law for law in LAWS.values()}

#: Beside each class of named numbers one of the same names, with a slot for each.
_SLOTTED: dict[type, type] = {
    kind: type(kind.__name__, (), {"__slots__": kind._fields})
    for kind in (
        *(pd.PdGains, pd_dob.PdDobGains, pd_lugre.PdLugreGains),
        *(local.LocalGains, weights.Sets, position.PositionTorques),
    )
}


def in_slots(named: Any) -> Any:
    """What `Law.named` gave with a slot for each name, as the loop holds it; anything else comes back as it is.

    The interpreter reads a slot five times as fast as a NamedTuple's field, and a step reads up to sixty of them.
    Compiled kernels take the NamedTuple.
    """
    kind = _SLOTTED.get(type(named))
    if kind is None:
        return named
    slotted = kind()
    for name, value in zip(named._fields, named, strict=True):
        setattr(slotted, name, in_slots(value))
    return slotted


#: What each law is called where people read it.
LABELS = {"pd": "PD", "pd_dob": "PD + DOB", "pd_lugre": "PD + LuGre", "local": "Local models"}
