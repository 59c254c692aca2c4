"""The joint between amplifier and encoder: the plant, advanced to the moment of each event.

Used by both nodes. The plant is an axis model file that the master never reads; its command delay is shortened by the
one period that the SYNC rules of CANopen already cost.
"""

from __future__ import annotations

from servod.common.units import NS_PER_S
from servod.formats.model.axis_model import AxisModel
from servod.kernels.physics.plant import Plant


class Joint:
    """A plant on the world's time line; SI units in joint coordinates. `load_nm` acts on it from outside: a weight."""

    def __init__(self, model: AxisModel, seed: int, period_s: float) -> None:
        self.plant = Plant(model, seed, delay_s=max(0.0, model.total_delay_s - period_s))
        self.inertia: float = model.inertia
        self.torque_nm = self.load_nm = 0.0
        self._now_ns: int | None = None

    def advance(self, time_ns: int) -> None:
        """Let the joint move until `time_ns`; an earlier moment changes nothing."""
        if self._now_ns is None:
            self._now_ns = time_ns
        elif time_ns > self._now_ns:
            self.plant.advance(self.torque_nm, (time_ns - self._now_ns) / NS_PER_S, self.load_nm)
            self._now_ns = time_ns

    def command(self, torque_nm: float, time_ns: int) -> None:
        """Produce `torque_nm` from `time_ns` on."""
        self.advance(time_ns)
        self.torque_nm = torque_nm
