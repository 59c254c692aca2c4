"""State of a control law: one layout for all laws, so that the controller can carry it over when the law changes.

Stands under the laws, which change it in place. Compiled it is a numpy record with the same names
(`servod.kernels.physics.compiled.record`), and the same source runs on both. (A read costs 16 ns by name in a slot,
18 by a constant in a list, 132 by an IntEnum; a NamedTuple made again in every step would be an allocation for each.)
"""

from __future__ import annotations

from dataclasses import dataclass, fields


@dataclass(slots=True)
class LawState:
    """What a law remembers from one step to the next; all zero before the first one."""

    z_hat: float = 0.0  # estimated bristle deflection [rad]; 0.0 where the law has none
    d_hat: float = 0.0  # estimated disturbance [N*m]; 0.0 where the law has none
    asked: float = 0.0  # torque asked for in the previous step, before limits [N*m]
    acted: float = 0.0  # torque that acted while the previous sample became the present one [N*m]
    last_velocity: float = 0.0  # velocity of the previous step [rad/s]
    modelled: float = 0.0  # friction torque that the law knew of in the previous step [N*m]
    started: float = 0.0  # 0.0 before the first step
    command_1: float = 0.0  # feedback u* of the last step, as the limits let it through
    command_2: float = 0.0  # of the step before
    command_3: float = 0.0
    rest: float = 0.0  # 0 moving to 1 at rest: how long the joint has been where it shall be


#: The names in the order in which a linearised law has them as rows and columns.
STATES = tuple(field.name for field in fields(LawState))
N_STATES = len(STATES)

#: What a state is called where a person reads of it, by its place.
STATE_NAMES = ("z_hat", "d_hat", "asked", "acted", "v_last", "modelled", "started", "u*_1", "u*_2", "u*_3", "rest")
#: States that a law may keep as they are: z_hat and d_hat while it holds, and all of an observer that it has not.
MAY_STAY = frozenset(map(STATES.index, ("z_hat", "d_hat", "acted", "last_velocity", "modelled", "started")))
