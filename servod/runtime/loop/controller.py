"""The controller as the loop holds it: one step interface over all laws, and bumpless change between them.

Step (4) of the cycle: after the axis state machine, before the limits. No exceptions, no logging in `step`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

from servod.kernels.laws import LAW_BY_NUMBER, LAWS, Law, in_slots
from servod.kernels.laws.state import LawState

#: Time constant of the offsets of torque and reference that make a change of controller bumpless [s].
BUMPLESS_TIME_S = 0.1
NEGLIGIBLE_OFFSET_NM = NEGLIGIBLE_OFFSET_RAD = 1e-9


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
        self._parameters = in_slots(self._law.named((0.0,) * self._law.n_parameters))
        self._state = LawState()
        self._offset_nm = self._offset_rad = 0.0
        self._hand_over_nm: float | None = None

    @property
    def law(self) -> Law:
        """The active law."""
        return self._law

    @property
    def friction_state(self) -> float:
        """Estimated bristle deflection z_hat in rad; 0.0 where the law has none."""
        return self._state.z_hat

    @property
    def disturbance(self) -> float:
        """Estimated disturbance in N*m; 0.0 where the law has none."""
        return self._state.d_hat

    def activate(self, law_number: int, parameters: Sequence[float], torque_now_nm: float) -> bool:
        """Change law or gains between two cycles; the next output is `torque_now_nm`, the torque that acts now.

        The new law begins with the reference where the joint stands; this offset, and that of the torque to what the
        law then asks, decay with the bumpless time constant. (An offset of torque alone would cancel the feedback of
        one region of a scheduled law, and be left over, in the wrong direction, when the joint comes into the other.) A
        friction state is carried over as torque, a disturbance estimate only within the same law. Returns False, and
        changes nothing, for an unknown law or parameters of the wrong length.
        """
        law = LAW_BY_NUMBER.get(law_number)
        if law is None or not law.accepts(parameters):
            return False
        named = in_slots(law.named(tuple(float(value) for value in parameters)))
        state = LawState(z_hat=self._carried_friction_state(law, named), asked=torque_now_nm)
        if law is self._law and math.isfinite(self._state.d_hat):
            state.d_hat = self._state.d_hat
        self._law, self._parameters, self._state = law, named, state
        self._offset_nm, self._hand_over_nm = 0.0, torque_now_nm
        return True

    def _carried_friction_state(self, law: Law, parameters: Any) -> float:
        z_hat, both = self._state.z_hat, self._law.has_friction_state and law.has_friction_state
        if not both or not math.isfinite(z_hat) or parameters.stiffness == 0.0:
            return 0.0
        return float(z_hat * self._parameters.stiffness / parameters.stiffness)

    def reset(self, torque_now_nm: float = 0.0) -> None:
        """Forget all states, e.g. at enable; the next output is `torque_now_nm`, as after `activate`."""
        self._state = LawState(asked=torque_now_nm)
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
        self._take_over(x_ref - x, dt)
        x_ref -= self._offset_rad
        torque, feedback, friction, other = self._law.step(
            self._parameters, self._state, x_ref, v_ref, a_ref, x, v, u_applied, dt
        )
        if self._hand_over_nm is not None:
            self._offset_nm = self._hand_over_nm - torque
            self._hand_over_nm = None
        torque += self._offset_nm + added_nm
        self._state.asked = torque
        return ControllerOutput(torque, feedback, friction, other + self._offset_nm + added_nm)

    def _take_over(self, error: float, dt: float) -> None:
        """The offsets of this cycle: the whole error in the first one after a change, then ever less."""
        if self._hand_over_nm is not None:
            self._offset_rad = error if math.isfinite(error) else 0.0
        elif self._offset_nm != 0.0 or self._offset_rad != 0.0:
            left = math.exp(-dt / self._bumpless_time_s)
            self._offset_nm, self._offset_rad = self._offset_nm * left, self._offset_rad * left
            if abs(self._offset_nm) < NEGLIGIBLE_OFFSET_NM:
                self._offset_nm = 0.0
            if abs(self._offset_rad) < NEGLIGIBLE_OFFSET_RAD:
                self._offset_rad = 0.0
