"""CiA 406 encoder: set-up face and cycle face. Step (2) of the cycle: a frame becomes angle and velocity of the joint.

The counter wraps at the measuring range (0x6002), which need not be a power of two; here it is unwrapped. The velocity
is the difference over the *measured* time, then a first-order low-pass with exact discretisation: a late or lost
sample changes the step of the filter, never its time constant.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any

from servod.common.errors import BadInput, Unreachable
from servod.common.units import NS_PER_S, rad_per_count, wrapped_difference
from servod.drivers.pdo_codec import codec, find, lost_after_cycles, slot, slow_syncs
from servod.kernels.filters import low_pass_share, velocity_delay_s
from servod.runtime.fieldbus.cia import TPDO_BASE, Obj406
from servod.runtime.fieldbus.devices import (
    ALARMS_STALE,
    NEVER_CYCLES,
    Driver,
    EncoderFeedback,
    NodePlan,
    PdoEntry,
    PdoMap,
    SdoAccess,
)
from servod.runtime.fieldbus.setup_tools import read_optional, write_checked

if TYPE_CHECKING:
    from servod.formats.config import AxisConfig

# --- The set-up face -------------------------------------------------------------------------------------------------
# Off the control path: states the wanted PDOs, checks resolution, reads the range.
#
# Resolution and scaling are checked, never changed: an encoder that another master uses too must not be rescaled by
# a configuration file. Only a preset is written, on request and at rest.


_SLOW_TIMER_MS = 100
_OPERATING_SCALING = 1 << 2  # 0x6000 bit 2: scaling function on


def encoder_pdos(node_id: int, slow_syncs: int) -> tuple[PdoMap, ...]:
    """The two PDOs of the encoder: alarms with every `slow_syncs`-th SYNC, position with each."""
    alarms = (PdoEntry(Obj406.ALARMS, 0, 16),)
    return (
        PdoMap(False, 1, TPDO_BASE[0] + node_id, slow_syncs, alarms, event_timer_ms=_SLOW_TIMER_MS),
        PdoMap(False, 2, TPDO_BASE[1] + node_id, 1, (PdoEntry(Obj406.POSITION, 0, 32),)),
    )


class EncoderSetup:
    """Set-up face of a CiA 406 encoder (servod.runtime.fieldbus.devices.Setup)."""

    def __init__(self, config: AxisConfig) -> None:
        self._encoder = config.encoder
        self._period_us = config.cycle.period_us

    def plan(self) -> NodePlan:
        """The wanted mapping and the facts of the configuration."""
        encoder = self._encoder
        facts: dict[str, Any] = {
            "period_s": self._period_us * 1e-6,
            "counts_per_turn": encoder.counts_per_turn,
            "direction": encoder.direction,
            "zero_offset_rad": encoder.zero_offset_rad,
            "velocity_cutoff_hz": encoder.velocity_cutoff_hz,
            "pdo_pairs": 2,
        }
        if encoder.measuring_range_counts is not None:
            facts["measuring_range_counts"] = encoder.measuring_range_counts
        pdos = encoder_pdos(encoder.node_id, slow_syncs(self._period_us))
        return NodePlan(encoder.driver, encoder.node_id, pdos, facts)

    def inspect(self, sdo: SdoAccess) -> None:
        """Refuse an encoder that shows alarms: its position may be wrong (CiA 406, 0x6503)."""
        alarms = read_optional(sdo, Obj406.ALARMS)
        if alarms:
            raise Unreachable(
                f"encoder node {self._encoder.node_id} shows alarms (0x6503 = 0x{alarms:04X}): "
                "check its supply and mounting, then start again"
            )

    def configure(self, sdo: SdoAccess) -> NodePlan:
        """Check resolution, read the range; raises BadInput, Unreachable."""
        encoder, plan = self._encoder, self.plan()
        self._check_resolution(sdo)
        measuring_range = self._measuring_range(sdo)
        wanted = encoder.measuring_range_counts
        if wanted is not None and wanted != measuring_range:
            raise BadInput("encoder.measuring_range_counts", f"{wanted}", f"{measuring_range}, what 0x6002 reads")
        plan.facts["measuring_range_counts"] = measuring_range
        return plan

    def _check_resolution(self, sdo: SdoAccess) -> None:
        """0x6001 counts when scaling is on, the physical 0x6501 when it is off (CiA 406, 0x6000 bit 2)."""
        scaled = (read_optional(sdo, Obj406.OPERATING_PARAMETERS) or 0) & _OPERATING_SCALING
        index = Obj406.UNITS_PER_TURN if scaled else Obj406.SINGLE_TURN_RESOLUTION
        counts = read_optional(sdo, index)
        if counts is None:
            index, counts = Obj406.UNITS_PER_TURN, sdo.read(Obj406.UNITS_PER_TURN)
        if counts != self._encoder.counts_per_turn:
            raise BadInput(
                "encoder.counts_per_turn", f"{self._encoder.counts_per_turn}", f"{counts}, what 0x{index:04X} reads"
            )

    def _measuring_range(self, sdo: SdoAccess) -> int:
        measuring_range = sdo.read(Obj406.MEASURING_RANGE)
        if measuring_range == 0:  # 2**32 does not fit into 32 bits; makers write it as 0
            return 2**32
        if measuring_range < self._encoder.counts_per_turn:
            node = self._encoder.node_id
            raise Unreachable(f"encoder node {node}: measuring range 0x6002 = {measuring_range} is less than one turn")
        return measuring_range

    def position_rad(self, sdo: SdoAccess) -> float:
        """Where the joint stands, as the cycle face decodes it: the turn nearest to zero."""
        encoder, span = self._encoder, self._measuring_range(sdo)
        counts_per_rad = encoder.direction / rad_per_count(encoder.counts_per_turn)
        zero = round(encoder.zero_offset_rad * counts_per_rad)
        counts = zero + wrapped_difference(sdo.read(Obj406.POSITION), zero % span, span)
        return counts / counts_per_rad - encoder.zero_offset_rad

    def preset(self, sdo: SdoAccess, position_rad: float) -> int:
        """Make the joint's present position read `position_rad` (0x6003); the device refuses it in motion.

        The inverse of what the cycle face decodes. Raises Unreachable when the device kept another value.
        """
        encoder = self._encoder
        counts_per_rad = encoder.direction / rad_per_count(encoder.counts_per_turn)
        span = self._measuring_range(sdo)
        most_rad = 0.5 * span * rad_per_count(encoder.counts_per_turn)
        if not abs(position_rad) < most_rad:  # NaN, too
            allowed = f"nearer to zero than {most_rad:.6g} rad, half of what the encoder measures (0x6002)"
            raise BadInput("position", f"{position_rad:g} rad", allowed)
        counts = round((position_rad + encoder.zero_offset_rad) * counts_per_rad) % span
        write_checked(sdo, Obj406.PRESET, 0, counts)
        return counts


# --- The cycle face --------------------------------------------------------------------------------------------------


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
