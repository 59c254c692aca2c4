"""The controller as the loop holds it: one step interface over all laws, and bumpless change between them.

Step (4) of the cycle: after the axis state machine, before the limits. No exceptions, no logging in `step`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from servod.kernels.laws import LAW_BY_NUMBER, LAWS, Law
from servod.kernels.laws.state import ASKED, DISTURBANCE, FRICTION_STATE

#: Time constant of the additive offset that makes a change of controller bumpless [s].
BUMPLESS_TIME_S = 0.1
NEGLIGIBLE_OFFSET_NM = 1e-9


class ControllerOutput(NamedTuple):
    """Torque asked for and its parts, in N*m; `u` is the sum of the other three."""

    u: float
    feedback: float
    friction: float
    other: float


class Controller:
    """Runs the active law. Starts with a PD law of zero gains, that is with no torque."""

    def __init__(self, bumpless_time_s: float = BUMPLESS_TIME_S) -> None:
        self._bumpless_time_s = bumpless_time_s
        self._law = LAWS["pd"]
        self._parameters: tuple[float, ...] = (0.0,) * self._law.n_parameters
        self._state = [0.0] * self._law.n_states
        self._offset_nm = 0.0
        self._hand_over_nm: float | None = None

    @property
    def law(self) -> Law:
        """The active law."""
        return self._law

    @property
    def friction_state(self) -> float:
        """Estimated bristle deflection z_hat in rad; 0.0 where the law has none."""
        return self._state[FRICTION_STATE]

    @property
    def disturbance(self) -> float:
        """Estimated disturbance in N*m; 0.0 where the law has none."""
        return self._state[DISTURBANCE]

    def activate(self, law_number: int, parameters: Sequence[float], torque_now_nm: float) -> bool:
        """Change law or gains between two cycles; the next output is `torque_now_nm`, the torque that acts now.

        The difference to what the new law asks becomes an offset that decays with the bumpless time constant. A
        friction state is carried over as torque, a disturbance estimate only within the same law. Returns False, and
        changes nothing, for an unknown law or parameters of the wrong length.
        """
        law = LAW_BY_NUMBER.get(law_number)
        if law is None or not law.accepts(parameters):
            return False
        values = tuple(float(value) for value in parameters)
        state = [0.0] * law.n_states
        state[FRICTION_STATE] = self._carried_friction_state(law, values)
        if law is self._law and math.isfinite(self._state[DISTURBANCE]):
            state[DISTURBANCE] = self._state[DISTURBANCE]
        state[ASKED] = torque_now_nm
        self._law, self._parameters, self._state = law, values, state
        self._offset_nm, self._hand_over_nm = 0.0, torque_now_nm
        return True

    def _carried_friction_state(self, law: Law, parameters: Sequence[float]) -> float:
        old, new = self._law.stiffness_index, law.stiffness_index
        if old is None or new is None or not math.isfinite(self._state[FRICTION_STATE]) or parameters[new] == 0.0:
            return 0.0
        return self._state[FRICTION_STATE] * self._parameters[old] / parameters[new]

    def reset(self, torque_now_nm: float = 0.0) -> None:
        """Forget all states, e.g. at enable; the next output is `torque_now_nm`, as after `activate`."""
        self._state = [0.0] * self._law.n_states
        self._state[ASKED] = torque_now_nm
        self._offset_nm, self._hand_over_nm = 0.0, torque_now_nm

    def step(
        self,
        x_ref: float,
        v_ref: float,
        a_ref: float,
        x: float,
        v: float,
        u_applied: float,
        dt: float,
        added_nm: float = 0.0,
    ) -> ControllerOutput:
        """One cycle; SI units. `u_applied` is the torque of the last cycle after limits, `dt` the time since then.

        `added_nm` is the torque of an excitation, which comes on top and counts as `other`.
        NaN in any measurement comes out as NaN: the limits decide what happens then, not the controller.
        """
        torque, feedback, friction, other = self._law.step(
            self._parameters, self._state, x_ref, v_ref, a_ref, x, v, u_applied, dt
        )
        if self._hand_over_nm is not None:
            self._offset_nm = self._hand_over_nm - torque
            self._hand_over_nm = None
        elif self._offset_nm != 0.0:
            self._offset_nm *= math.exp(-dt / self._bumpless_time_s)
            if abs(self._offset_nm) < NEGLIGIBLE_OFFSET_NM:
                self._offset_nm = 0.0
        torque += self._offset_nm + added_nm
        self._state[ASKED] = torque
        return ControllerOutput(torque, feedback, friction, other + self._offset_nm + added_nm)
