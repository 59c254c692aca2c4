"""State of a control law: one layout for all laws, so that the engine can carry it over when the law changes.

Stands under the laws. A law's state is a list of `N_STATES` floats (a float64 array when compiled), changed in place.
"""

from __future__ import annotations

N_STATES = 11

FRICTION_STATE = 0  # z_hat, estimated bristle deflection [rad]; 0.0 where the law has none
DISTURBANCE = 1  # d_hat, estimated disturbance [N*m]; 0.0 where the law has none
ASKED = 2  # torque asked for in the previous step, before limits [N*m]
ACTED = 3  # torque that acted while the previous sample became the present one [N*m]
LAST_VELOCITY = 4  # velocity of the previous step [rad/s]
MODELLED = 5  # friction torque that the law knew of in the previous step [N*m]
STARTED = 6  # 0.0 before the first step
COMMAND_1 = 7  # feedback u* of the last step, as the limits let it through
COMMAND_2 = 8  # of the step before
COMMAND_3 = 9
REST = 10  # 0 moving to 1 at rest: how long the joint has been where it shall be

#: What a state is called where a person reads of it, by its place.
STATE_NAMES = ("z_hat", "d_hat", "asked", "acted", "v_last", "modelled", "started", "u*_1", "u*_2", "u*_3", "rest")
#: States that a law may keep as they are: z_hat and d_hat while it holds, and all of an observer that it has not.
MAY_STAY = frozenset({FRICTION_STATE, DISTURBANCE, ACTED, LAST_VELOCITY, MODELLED, STARTED})
