"""The joint between amplifier and encoder: the plant, advanced to the moment of each event.

Used by both nodes. The plant is an axis model file that the master never reads; its command delay is shortened by the
one period that the SYNC rules of CANopen already cost. Its holding brake: a spring closes it, a coil opens it, each
after its time. With `brake: output` the coil hangs on an output of the drive (0x60FE), whatever the drive does with its
torque: who opens it without torque lets the load fall. With `brake: drive` the amplifier sequences it: open while it
follows commands, closed before the torque goes after a stop, closed too late after everything that cuts the torque.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from servod.common.units import NS_PER_S
from servod.drivers.virtual.settings import VirtualAxisSettings
from servod.drivers.virtual.timeline import Timeline
from servod.formats.model.axis_model import AxisModel
from servod.kernels.physics.plant import Plant

#: Bit of 0x60FE:1 that opens the brake, where its mask (0x60FE:2) lets it.
BRAKE_BIT = 1 << 16
#: A closed brake is followed in steps of this length [s], as a spring of this frequency [1/s] that slips at its torque.
_BRAKE_STEP_S, _BRAKE_RATE = 100e-6, 3000.0


class Joint:
    """A plant on the world's time line; SI units in joint coordinates. `load_nm` acts on it from outside: a weight.

    `brake_closed` holds it with at most `brake_nm`, by friction: beyond that it slips.
    """

    def __init__(self, model: AxisModel, seed: int, period_s: float, brake_nm: float = 0.0) -> None:
        self.plant = Plant(model, seed, delay_s=max(0.0, model.total_delay_s - period_s))
        self.inertia: float = model.inertia
        self.torque_nm = self.load_nm = 0.0
        self._now_ns: int | None = None
        self.brake_closed, self._brake_nm = False, brake_nm
        self._held_rad: float | None = None

    def advance(self, time_ns: int) -> None:
        """Let the joint move until `time_ns`; an earlier moment changes nothing."""
        if self._now_ns is None:
            self._now_ns = time_ns
        elif time_ns > self._now_ns:
            duration_s = (time_ns - self._now_ns) / NS_PER_S
            self._now_ns = time_ns
            if self.brake_closed:
                self._advance_braked(duration_s)
            else:
                self._held_rad = None
                self.plant.advance(self.torque_nm, duration_s, self.load_nm)

    def _advance_braked(self, duration_s: float) -> None:
        """A stiff, well damped spring to where the brake closed; what would be more than its torque makes it slip."""
        plant, stiffness = self.plant, self.inertia * _BRAKE_RATE**2
        damping = 2.0 * self.inertia * _BRAKE_RATE
        steps = max(1, math.ceil(duration_s / _BRAKE_STEP_S))
        for _ in range(steps):
            if self._held_rad is None:
                self._held_rad = plant.position_rad
            wanted_nm = stiffness * (self._held_rad - plant.position_rad) - damping * plant.velocity_rad_s
            holds_nm = min(max(wanted_nm, -self._brake_nm), self._brake_nm)
            if holds_nm != wanted_nm:
                self._held_rad = None
            plant.advance(self.torque_nm, duration_s / steps, self.load_nm + holds_nm)

    def command(self, torque_nm: float, time_ns: int) -> None:
        """Produce `torque_nm` from `time_ns` on."""
        self.advance(time_ns)
        self.torque_nm = torque_nm


class JointBrake:
    """The coil and its delays; `sequenced`: by the amplifier."""

    def __init__(
        self, settings: VirtualAxisSettings, joint: Joint, timeline: Timeline, stuck: Callable[[], bool]
    ) -> None:
        """`stuck`: it does not open whatever the coil does."""
        self.sequenced = settings.brake == "drive"
        self._by_output = settings.brake == "output"
        self._release_ns = round(settings.brake_release_s * 1e9)
        self._engage_ns = round(settings.brake_engage_s * 1e9)
        self._joint, self._stuck, self._coil = joint, stuck, False
        joint.brake_closed = settings.brake != "none"
        self._moves = timeline.timer(self._moved)
        self._closed = timeline.timer(self._held)
        self._then: Callable[[int], None] = lambda time_ns: None

    def output(self, value: int, mask: int, time_ns: int) -> None:
        """The outputs were written."""
        if self._by_output:
            self._switch(bool(value & mask & BRAKE_BIT), time_ns)

    def torque(self, on: bool, time_ns: int) -> None:
        """The amplifier begins to follow commands, or cuts the torque."""
        self._closed.cancel()
        if self.sequenced:
            self._switch(on, time_ns)

    def close_then(self, then: Callable[[int], None], time_ns: int) -> None:
        """The amplifier holds at rest: close, and go on when it is closed."""
        if not self.sequenced:
            then(time_ns)
            return
        self._switch(False, time_ns)
        self._then = then
        self._closed.arm(time_ns + self._engage_ns)

    def _held(self, time_ns: int) -> None:
        self._then(time_ns)

    def _switch(self, on: bool, time_ns: int) -> None:
        if on is not self._coil:
            self._coil = on
            self._moves.arm(time_ns + (self._release_ns if on else self._engage_ns))

    def _moved(self, time_ns: int) -> None:
        self._joint.advance(time_ns)
        self._joint.brake_closed = not self._coil or self._stuck()
