"""The samples of a table motion between client and loop, and the check of any motion before the loop is asked.

Around the loop. Extent and speed are kept while the samples come in, so that starting a long motion takes no time.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Sequence
from itertools import pairwise

from servod.common.errors import BadInput, Unreachable
from servod.formats.config import AxisConfig
from servod.formats.protocol import SampleKey
from servod.formats.recording.record import CycleRecord
from servod.runtime.loop.channel import TRAJECTORY_SAMPLES
from servod.runtime.loop.commands import REFUSAL_TEXT, ReferenceKind, Refusal
from servod.runtime.loop.references import Motion, make_motion

#: Which argument of `track` makes a motion jump.
_JUMPS_BY = {
    ReferenceKind.SINE: "sine: frequency_hz",
    ReferenceKind.STEP: "step: amplitude_rad",
    ReferenceKind.TABLE: "csv: positions_rad",
    ReferenceKind.EXCITE: "excite: positions_rad",
}


class MotionSamples:
    """One column of samples, with its extent and its largest step."""

    def __init__(self, values: Sequence[float] = ()) -> None:
        self.values = array("d")
        self.lowest, self.highest, self.largest_step = math.inf, -math.inf, 0.0
        if values:
            self.extend(values)

    def extend(self, piece: Sequence[float]) -> None:
        """Add a piece, which is not empty, at the end."""
        before = [*self.values[-1:], *piece]
        self.lowest, self.highest = min(self.lowest, *piece), max(self.highest, *piece)
        steps = (abs(there - here) for here, there in pairwise(before))
        self.largest_step = max(self.largest_step, *steps, 0.0)
        self.values.extend(piece)


class MotionTable:
    """What a table motion reads: positions in rad, and for an excitation as many torques in N*m."""

    def __init__(self, positions_rad: Sequence[float] | None = None, torques_nm: Sequence[float] | None = None) -> None:
        self._columns = {
            SampleKey.POSITIONS: MotionSamples(positions_rad or ()),
            SampleKey.TORQUES: MotionSamples(torques_nm or ()),
        }

    @property
    def positions(self) -> MotionSamples:
        """The positions."""
        return self._columns[SampleKey.POSITIONS]

    @property
    def torques(self) -> MotionSamples:
        """The torques."""
        return self._columns[SampleKey.TORQUES]

    def add(self, key: SampleKey, start: int, piece: Sequence[float]) -> None:
        """Add a piece of a column; `start` 0 begins the column again. Raises BadInput on a gap or too much."""
        if start == 0:
            self._columns[key] = MotionSamples()
        column = self._columns[key]
        if start != len(column.values):
            raise BadInput("trajectory: start", start, f"0, or {len(column.values)} to go on")
        if start + len(piece) > TRAJECTORY_SAMPLES:
            raise BadInput(f"trajectory: {key}", f"{start + len(piece)} samples", f"at most {TRAJECTORY_SAMPLES}")
        column.extend(piece)

    def require(self, torques: bool) -> None:
        """Raises BadInput unless the motion is complete; with `torques` it needs one for each position."""
        count, most = len(self.positions.values), TRAJECTORY_SAMPLES // (2 if torques else 1)
        if not 2 <= count <= most:
            raise BadInput("track: positions_rad", f"{count} samples", f"2 to {most}")
        if torques and len(self.torques.values) != count:
            raise BadInput("track: torques_nm", f"{len(self.torques.values)} samples", f"{count}, as positions_rad")

    def area(self) -> array[float]:
        """What goes into the trajectory area: the positions, and behind them the torques."""
        return self.positions.values + self.torques.values


def check_motion(reference: Sequence[float], table: MotionTable, config: AxisConfig, now: CycleRecord) -> None:
    """Check the arguments of Op.REFERENCE and their table against range, speed and following error, from the present
    reference on.

    Raises Unreachable with the figures, and BadInput where the reference jumps; the loop judges again, without them.
    """
    limits, period_s = config.limits, config.cycle.period_us * 1e-6
    motion = make_motion(reference, period_s, table.area())
    if isinstance(motion, Refusal):
        raise Unreachable(f"refused: {REFUSAL_TEXT[motion]}")
    lowest, highest = now.reference_rad + motion.lowest_rad, now.reference_rad + motion.highest_rad
    if not limits.position_min_rad <= lowest <= highest <= limits.position_max_rad:
        raise Unreachable(
            f"refused: the motion would go from {lowest:.6g} to {highest:.6g} rad; limits.position_min_rad to "
            f"position_max_rad allow {limits.position_min_rad:.6g} to {limits.position_max_rad:.6g} rad"
        )
    speed_rad_s = max(motion.speed_rad_s, table.positions.largest_step / period_s)
    if not speed_rad_s <= limits.speed_rad_s:
        allowed = f"limits.speed_rad_s allows {limits.speed_rad_s:.6g} rad/s"
        raise Unreachable(f"refused: the motion would be as fast as {speed_rad_s:.6g} rad/s; {allowed}")
    _check_jumps(ReferenceKind(int(reference[0])), motion, speed_rad_s * period_s, config, now)


def _check_jumps(kind: ReferenceKind, motion: Motion, row_rad: float, config: AxisConfig, now: CycleRecord) -> None:
    """No jump of the reference may end in a following error at once, neither at the start nor from row to row, where
    the largest is `row_rad`. Raises BadInput."""
    window_rad = config.limits.following_error_rad
    start_rad = abs(now.reference_rad + motion.first_rad(config.cycle.period_us * 1e-6) - now.position_rad)
    if start_rad <= window_rad and row_rad <= window_rad:
        return
    found = f"a reference {start_rad:.6g} rad from the joint at once"
    if start_rad <= window_rad:
        found = f"a reference that jumps by {row_rad:.6g} rad in one cycle"
    allowed = f"at most limits.following_error_rad, {window_rad:.6g} rad"
    remedy = "take a smaller step, or a ramp from a file (`servoctl track csv`)"
    raise BadInput(f"track {_JUMPS_BY.get(kind, kind.name.lower())}", found, f"{allowed}; {remedy}")
