"""CiA 406 encoder: the set-up face. Off the control path: states the wanted PDOs, checks resolution, reads the range.

Resolution and scaling are checked, never changed: an encoder that another master uses too must not be rescaled by a
configuration file. Only a preset is written, on request and at rest.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from servod.common.errors import BadInput, Unreachable
from servod.common.units import rad_per_count, wrapped_difference
from servod.runtime.fieldbus.cia import TPDO_BASE, Obj406
from servod.runtime.fieldbus.devices import NodePlan, PdoEntry, PdoMap, SdoAccess
from servod.runtime.fieldbus.setup_tools import read_optional, write_checked

if TYPE_CHECKING:
    from servod.formats.config import AxisConfig

_SLOW_TIMER_MS = 100
_OPERATING_SCALING = 1 << 2  # 0x6000 bit 2: scaling function on


def encoder_pdos(node_id: int) -> tuple[PdoMap, ...]:
    """The two PDOs of the encoder: alarms by event timer, position at each SYNC."""
    return (
        PdoMap(False, 1, TPDO_BASE[0] + node_id, 255, (PdoEntry(Obj406.ALARMS, 0, 16),), event_timer_ms=_SLOW_TIMER_MS),
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
        return NodePlan(encoder.driver, encoder.node_id, encoder_pdos(encoder.node_id), facts)

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
        counts = round((position_rad + encoder.zero_offset_rad) * counts_per_rad) % self._measuring_range(sdo)
        write_checked(sdo, Obj406.PRESET, 0, counts)
        return counts
