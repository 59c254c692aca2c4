"""Control laws: plain functions on floats, called by the loop as they are and compiled by the simulator.

Step (4) of the cycle. `LAWS` is the one table of laws; the numbers are stable, gain sets and the loop's ACTIVATE
command carry them. `engine.Controller` is what the loop holds.
"""

from __future__ import annotations

from collections.abc import Callable, MutableSequence, Sequence
from dataclasses import dataclass
from enum import IntEnum

from servod.kernels.laws import local, pd, pd_dob, pd_lugre, position
from servod.kernels.laws.state import N_STATES

#: step(p, s, x_ref, v_ref, a_ref, x, v, u_applied, dt) -> (torque, feedback, friction, other), SI units.
Step = Callable[
    [Sequence[float], MutableSequence[float], float, float, float, float, float, float, float],
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

    `n_parameters` is the length of `p`; for `local` without its sets (three floats each) and what is known of position.
    `stiffness_index` is where c0 [N*m/rad] stands in `p`, None for a law without friction state; the engine uses it
    to carry the friction *torque* over when two laws scale their state differently.
    """

    name: str
    number: LawNumber
    step: Step
    n_parameters: int
    stiffness_index: int | None = None
    n_states: int = N_STATES

    def accepts(self, parameters: Sequence[float]) -> bool:
        """Whether `parameters` has the length that this law reads, so that no index can fail inside the cycle."""
        if self.number is not LawNumber.LOCAL:
            return len(parameters) == self.n_parameters
        if len(parameters) <= local.N_SETS:
            return False
        n = parameters[local.N_SETS]
        return 2 <= n <= MAX_SETS and position.fits(len(parameters) - self.n_parameters - 3 * int(n))


LAWS: dict[str, Law] = {
    law.name: law
    for law in (
        Law("pd", LawNumber.PD, pd.step, pd.N_PARAMETERS),
        Law("pd_dob", LawNumber.PD_DOB, pd_dob.step, pd_dob.N_PARAMETERS),
        Law("pd_lugre", LawNumber.PD_LUGRE, pd_lugre.step, pd_lugre.N_PARAMETERS, pd_lugre.STIFFNESS),
        Law("local", LawNumber.LOCAL, local.step, local.FIRST_NODE, local.STIFFNESS),
    )
}

LAW_BY_NUMBER: dict[int, Law] = {int(law.number): law for law in LAWS.values()}

#: What each law is called where people read it.
LABELS = {"pd": "PD", "pd_dob": "PD + DOB", "pd_lugre": "PD + LuGre", "local": "Local models"}
