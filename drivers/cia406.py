"""CiA 406 encoder: the cycle face. Step (2) of the cycle: a position frame becomes angle and velocity of the joint.

The counter wraps at the measuring range (0x6002), which need not be a power of two; here it is unwrapped. The velocity
is the difference over the *measured* time, then a first-order low-pass with exact discretisation: a late or lost
sample changes the step of the filter, never its time constant.
"""

from __future__ import annotations

import struct

from servod.common.units import NS_PER_S, rad_per_count, wrapped_difference
from servod.drivers.cia406_setup import EncoderSetup
from servod.drivers.pdo_codec import codec, find, lost_after_cycles, slot
from servod.kernels.filters import low_pass_share, velocity_delay_s
from servod.runtime.fieldbus.cia import Obj406
from servod.runtime.fieldbus.devices import ALARMS_STALE, NEVER_CYCLES, Driver, EncoderFeedback, NodePlan

#: Lengths of the objects that this driver decodes (CiA 406).
_FORMATS: dict[int, str] = {Obj406.POSITION: "I", Obj406.ALARMS: "H", Obj406.WARNINGS: "H"}


class Cia406Encoder:
    """Cycle face of a CiA 406 encoder; see servod.runtime.fieldbus.devices for the behaviour it keeps."""

    def __init__(self, plan: NodePlan) -> None:
        facts = plan.facts
        position_pdo = find(plan, False, (Obj406.POSITION,))
        self._position_id = position_pdo.cob_id
        self._position_codec = codec(position_pdo, _FORMATS, plan.driver)
        self._position_slot = slot(position_pdo, Obj406.POSITION)
        alarm_pdo = next((p for p in plan.pdos if Obj406.ALARMS in {e.index for e in p.entries}), None)
        self._alarm_id = -1 if alarm_pdo is None else alarm_pdo.cob_id
        self._alarm_codec = struct.Struct("<H") if alarm_pdo is None else codec(alarm_pdo, _FORMATS, plan.driver)
        self._alarm_slot = 0 if alarm_pdo is None else slot(alarm_pdo, Obj406.ALARMS)
        self._alarm_limit_cycles = lost_after_cycles(alarm_pdo, float(facts["period_s"]))
        self._range = int(facts["measuring_range_counts"])
        self._rad_per_count = int(facts["direction"]) * rad_per_count(int(facts["counts_per_turn"]))
        self._zero_offset_rad = float(facts["zero_offset_rad"])
        self._zero_counts = round(self._zero_offset_rad / self._rad_per_count)
        self._cutoff_hz = float(facts["velocity_cutoff_hz"])
        self.receive_ids: tuple[int, ...] = (self._position_id,) + (() if alarm_pdo is None else (self._alarm_id,))
        self.sync_frames = 1
        self.delay_s = velocity_delay_s(float(facts["period_s"]), self._cutoff_hz)
        self.ignored_frames = 0
        self._raw = -1  # before the first sample
        self._unwrapped = 0
        self._time_ns = 0
        self._position_rad = 0.0
        self._velocity_rad_s = 0.0
        self._alarms = 0
        self._alarm_age_cycles = 0
        self._fresh = False
        self._age_cycles = NEVER_CYCLES

    def on_frame(self, can_id: int, data: bytes, time_ns: int) -> bool:
        """Take one frame; True when it was this cycle's position. Short and impossible ones are ignored, counted."""
        if can_id == self._position_id:
            return self._take_position(data, time_ns)
        if can_id == self._alarm_id:
            if len(data) < self._alarm_codec.size:
                self.ignored_frames += 1
            else:
                self._alarms = self._alarm_codec.unpack_from(data)[self._alarm_slot]
                self._alarm_age_cycles = 0
        return False

    def _take_position(self, data: bytes, time_ns: int) -> bool:
        if len(data) < self._position_codec.size:
            self.ignored_frames += 1
            return False
        raw = self._position_codec.unpack_from(data)[self._position_slot]
        if raw >= self._range:  # not a position of this encoder: wrong range, or a corrupted counter
            self.ignored_frames += 1
            return False
        if self._raw < 0:  # first sample: no velocity yet; the turn nearest to zero, so -1 count is not a full range
            self._unwrapped = self._zero_counts + wrapped_difference(raw, self._zero_counts, self._range)
        else:
            self._move(wrapped_difference(raw, self._raw, self._range), time_ns - self._time_ns)
        self._raw, self._time_ns, self._fresh = raw, time_ns, True
        self._position_rad = self._unwrapped * self._rad_per_count - self._zero_offset_rad
        return True

    def _move(self, counts: int, elapsed_ns: int) -> None:
        self._unwrapped += counts
        if elapsed_ns <= 0:  # two frames with one stamp tell nothing of the velocity
            return
        elapsed_s = elapsed_ns / NS_PER_S
        velocity = counts * self._rad_per_count / elapsed_s
        self._velocity_rad_s += low_pass_share(self._cutoff_hz, elapsed_s) * (velocity - self._velocity_rad_s)

    def read(self) -> EncoderFeedback:
        """The feedback of this cycle; each call is one cycle, so the age grows by one when no sample came."""
        self._age_cycles = 0 if self._fresh else self._age_cycles + 1
        self._fresh = False
        self._alarm_age_cycles += 1
        alarms, limit = self._alarms, self._alarm_limit_cycles
        if limit is not None and self._alarm_age_cycles > limit:
            alarms |= ALARMS_STALE
        return EncoderFeedback(self._time_ns, self._age_cycles, self._position_rad, self._velocity_rad_s, alarms)


DRIVER = Driver(kind="encoder", setup=EncoderSetup, cyclic=Cia406Encoder)
