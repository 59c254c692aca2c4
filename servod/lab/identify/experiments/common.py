"""What the experiments share: the axis, the bounds, where recordings go, and how a motion is run.

Between the walk and the axis. A motion that an interrupted walk has recorded already is not run again: the axis is
enabled, and moved to where it has to be, only before the first motion that is missing.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from servod.client.axis import AxisClient, AxisDropped, ReferenceMotion
from servod.common.errors import AnswerIsNo
from servod.formats.gains.gain_set import pd_set
from servod.lab.identify.bounds import Bounds
from servod.lab.identify.shapes import samples
from servod.lab.identify.store import motion_hash
from servod.lab.identify.trace import ExperimentKind, RecordedMotion, trace_of
from servod.lab.recordings.recording import Rows, moving, rows_of

Array = NDArray[np.float64]

#: Name of the gain set that experiments run under, in the store of the axis.
GAIN_NAME = "identify_pd"
#: What rounding may add to a planned way or speed.
ROUNDING = 1.02
#: Speed is looked at over this time: long enough for the encoder's steps, short against any motion that matters.
SPEED_SPAN_S = 0.004


class ExperimentEnded(AnswerIsNo):
    """The axis dropped out of an experiment; `trace` is what it recorded until then, None where there is nothing."""

    def __init__(self, message: str, trace: RecordedMotion | None) -> None:
        super().__init__(message)
        self.trace = trace


class Keeper(Protocol):
    """Where recordings go, and where those of an interrupted walk come from (`store.Recordings`)."""

    def recorded(self, kind: ExperimentKind, motion: str) -> RecordedMotion | None:
        """The earlier recording of this motion, if there is one."""
        ...

    def keep(self, rows: Rows, trace: RecordedMotion, motion: str) -> RecordedMotion:
        """Keep a motion; returns its trace with the recording's hash."""
        ...


class _Move(NamedTuple):
    """A move of the reference that nobody records."""

    position_rad: float
    gains: tuple[float, float]
    speed_rad_s: float


@dataclass
class Bench:
    """The axis on the test bench: what every experiment is given."""

    axis: AxisClient
    bounds: Bounds
    keeper: Keeper
    rng: np.random.Generator
    position_rad: float = 0.0  # of the reference, relative to `start_rad`
    start_rad: float = 0.0  # where the axis stood when the walk began
    enabled: bool = True
    traces: list[RecordedMotion] = field(default_factory=list)
    _gains: tuple[float, float] = (0.0, 0.0)
    _missed: _Move | None = None  # what has to be made up for before the first motion that is really run

    @property
    def period_s(self) -> float:
        """The loop's period."""
        return self.axis.config.cycle.period_us * 1e-6

    @property
    def resolution_rad(self) -> float:
        """Angle of one count of the joint's encoder."""
        return 2.0 * np.pi / self.axis.config.encoder.counts_per_turn

    def set_gains(self, position_nm_per_rad: float, velocity_nms_per_rad: float) -> None:
        """PD feedback of the motions to come."""
        self._gains = (position_nm_per_rad, velocity_nms_per_rad)
        if self.enabled:
            change_feedback(self.axis, *self._gains)

    def run(
        self, kind: ExperimentKind, positions: Array, torques: Array, window_rad: float, settings: dict[str, float]
    ) -> RecordedMotion:
        """Run one motion, keep its recording, return its trace.

        Raises AnswerIsNo when the bounds forbid it, or when the joint moved faster than they allow.
        """
        self._check(positions, torques)
        window_rad = min(window_rad, self.bounds.window_rad)
        motion = motion_hash(positions, torques, window_rad)
        trace = self.keeper.recorded(kind, motion) if not self.enabled else None
        if trace is None:
            trace = self._record(kind, motion, positions, torques, window_rad, settings)
            self._check_speed(trace)
        self.position_rad += float(positions[-1])
        self.traces.append(trace)
        return trace

    def go_to(self, position_rad: float, gains: tuple[float, float], speed_rad_s: float) -> None:
        """Move the reference to `position_rad` (relative to the start), without recording it."""
        self.set_gains(*gains)
        if self.enabled:
            way = position_rad - self.position_rad
            duration_s = max(0.2, 0.5 * np.pi * abs(way) / speed_rad_s)
            t = np.linspace(0.0, 1.0, max(2, round(duration_s / self.period_s)))
            path = way * (0.5 - 0.5 * np.cos(np.pi * t))
            self._check_plan(path)
            self._excite(path, np.zeros(len(t)), self.bounds.window_rad)
        else:
            self._missed = _Move(position_rad, gains, speed_rad_s)
        self.position_rad = position_rad

    def rest(self, duration_s: float) -> None:
        """Wait under the present gains, without recording it."""
        if self.enabled:
            still = np.zeros(samples(duration_s, self.period_s))
            self._excite(still, still, self.bounds.window_rad)

    def of(self, *kinds: ExperimentKind) -> list[RecordedMotion]:
        """Traces of these kinds so far."""
        return [trace for trace in self.traces if trace.kind in kinds]

    def _record(
        self,
        kind: ExperimentKind,
        motion: str,
        positions: Array,
        torques: Array,
        window_rad: float,
        settings: dict[str, float],
    ) -> RecordedMotion:
        """Run the motion on the axis. Raises ExperimentEnded, with its trace, when the axis drops out."""
        self._wake()
        settings = {"resolution_rad": self.resolution_rad, **settings}
        try:
            rows = self._excite(positions, torques, window_rad)
        except AxisDropped as dropped:
            rows = moving(rows_of(dropped.raw))
            raise ExperimentEnded(str(dropped), trace_of(kind, rows, settings) if len(rows) else None) from None
        return self.keeper.keep(rows, trace_of(kind, rows, settings), motion)

    def _wake(self) -> None:
        """Enable the axis, if it is not yet, and bring it to where the walk has come."""
        if self.enabled:
            return
        gains, self.enabled = self._gains, True
        self.position_rad = enable_powerless(self.axis) - self.start_rad
        if self._missed is not None:
            self.go_to(*self._missed)
        self.set_gains(*gains)

    def _excite(self, positions: Array, torques: Array, window_rad: float) -> Rows:
        motion = ReferenceMotion.excite(positions.tolist(), torques.tolist(), window_rad)
        return moving(rows_of(self.axis.run(motion)))

    def _check(self, positions: Array, torques: Array) -> None:
        self._check_plan(positions)
        farthest = np.max(np.abs(positions + self.position_rad - self.bounds.centre_rad))
        if farthest > self.bounds.travel_rad * ROUNDING:
            raise AnswerIsNo(f"an experiment would travel {farthest:.3g} rad, {self.bounds.travel_rad:.3g} are allowed")
        if np.max(np.abs(torques)) > self.bounds.torque_nm:
            raise AnswerIsNo(
                f"an experiment would need {np.max(np.abs(torques)):.3g} N*m, {self.bounds.torque_nm:.3g} are allowed"
            )

    def _check_plan(self, positions: Array) -> None:
        fastest = float(np.max(np.abs(np.diff(positions)))) / self.period_s
        if fastest > self.bounds.speed_rad_s * ROUNDING:
            raise AnswerIsNo(
                f"an experiment would go at {fastest:.3g} rad/s, {self.bounds.speed_rad_s:.3g} are allowed"
            )

    def _check_speed(self, trace: RecordedMotion) -> None:
        """What the joint did, not what was planned: nothing but friction holds it where no feedback acts."""
        seen = peak_speed(trace, SPEED_SPAN_S) - self.resolution_rad / SPEED_SPAN_S
        if seen > self.bounds.most_rad_s:
            raise AnswerIsNo(
                f"the joint went at {seen:.3g} rad/s in the experiment {trace.kind.value}, "
                f"{self.bounds.most_rad_s:.3g} are allowed: by its own friction it is faster as soon as it slides; "
                f"allow {2.0 * seen:.2g} rad/s (--speed, limits.speed_rad_s)"
            )


def enable_powerless(axis: AxisClient) -> float:
    """Enable under no torque; the present position in rad."""
    change_feedback(axis, 0.0, 0.0)
    axis.enable()
    return axis.status().position_rad


def change_feedback(axis: AxisClient, position_nm_per_rad: float, velocity_nms_per_rad: float) -> None:
    """Run this PD feedback on trial: whatever ends the experiments, the set of before comes back."""
    gains = pd_set(GAIN_NAME, position_nm_per_rad, velocity_nms_per_rad, tool="servoctl identify")
    axis.activate(*axis.load(gains))


def peak_speed(trace: RecordedMotion, span_s: float) -> float:
    """The highest mean speed over `span_s` in a recording, in rad/s; 0 for one that is shorter."""
    span = max(1, round(span_s / trace.period_s))
    ways = np.abs(trace.position_rad[span:] - trace.position_rad[:-span])
    return float(np.max(ways, initial=0.0)) / (span * trace.period_s)
