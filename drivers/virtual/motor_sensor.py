"""The amplifier's own position sensor on the motor, and the user units of its objects.

Between the joint and everything in the amplifier that needs position or velocity.
"""

from __future__ import annotations

from servod.common.units import NS_PER_S, TWO_PI
from servod.drivers.virtual.dictionary import DeviceDictionary
from servod.drivers.virtual.joint import Joint
from servod.runtime.fieldbus.cia import Obj402

_CUTOFF_RAD_S = TWO_PI * 200.0
#: Samples closer together than this keep the velocity that was known [ns].
_SHORTEST_NS = 200_000
_POLARITY_POSITION = 0x80


class MotorSensor:
    """Counts of the motor's encoder; velocity by difference and first-order low-pass."""

    def __init__(self, dictionary: DeviceDictionary, joint: Joint, counts_per_turn: int, gear_ratio: float) -> None:
        self._dictionary, self._joint, self.gear_ratio = dictionary, joint, gear_ratio
        self.counts_per_rad = counts_per_turn * gear_ratio / TWO_PI  # of the joint
        self.counts = 0
        self.velocity_rad_s = 0.0
        self._sampled_ns: int | None = None
        self._sampled_counts = 0
        self.user_per_count = 1.0
        self.scale()

    @property
    def user_per_rad(self) -> float:
        """User units of 0x6064 for one rad of the joint."""
        return self.counts_per_rad * self.user_per_count

    @property
    def speed_rpm(self) -> float:
        """Motor speed for the guard of 0x6080."""
        return self.velocity_rad_s * self.gear_ratio * 60.0 / TWO_PI

    def scale(self) -> None:
        """Take over 0x608F, 0x6091, 0x6092 and 0x607E: position = counts * feed / (increments * gear)."""
        value = self._dictionary.value
        increments = value(Obj402.ENCODER_RESOLUTION, 1) / value(Obj402.ENCODER_RESOLUTION, 2)
        gear = value(Obj402.GEAR_RATIO, 1) / value(Obj402.GEAR_RATIO, 2)
        feed = value(Obj402.FEED, 1) / value(Obj402.FEED, 2)
        sign = -1.0 if value(Obj402.POLARITY) & _POLARITY_POSITION else 1.0
        self.user_per_count = sign * feed / (increments * gear)

    def sample(self, time_ns: int) -> None:
        """Read the sensor at `time_ns`."""
        joint = self._joint
        joint.advance(time_ns)
        self.counts = counts = round(joint.plant.motor_position_rad * self.counts_per_rad)
        if self._sampled_ns is None:
            self._sampled_ns, self._sampled_counts = time_ns, counts
            return
        span_ns = time_ns - self._sampled_ns
        if span_ns >= _SHORTEST_NS:
            span_s = span_ns / NS_PER_S
            raw = (counts - self._sampled_counts) / (self.counts_per_rad * span_s)
            self.velocity_rad_s += (raw - self.velocity_rad_s) * span_s / (span_s + 1.0 / _CUTOFF_RAD_S)
            self._sampled_ns, self._sampled_counts = time_ns, counts

    def position_rad(self) -> float:
        """Position of the joint as the amplifier sees it."""
        return self.counts / self.counts_per_rad
