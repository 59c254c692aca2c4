"""What the experiments share: the axis, the bounds, where recordings go, and how a motion is run.

Between the walk and the links.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from servod.errors import AnswerIsNo
from servod.identify.bounds import Bounds
from servod.identify.links import Link
from servod.identify.trace import Kind, Trace, trace_of

Array = NDArray[np.float64]

#: Called with every recording as soon as it exists: its cycles, and the trace that the fits take.
Keep = Callable[[NDArray[np.void], Trace], None]


@dataclass
class Bench:
    """The axis on the test bench: what every experiment is given."""

    link: Link
    bounds: Bounds
    keep: Keep
    rng: np.random.Generator
    position_rad: float = 0.0  # of the reference, relative to where the axis stood at first
    traces: list[Trace] = field(default_factory=list)

    @property
    def period_s(self) -> float:
        """The loop's period."""
        return self.link.config.cycle.period_us * 1e-6

    @property
    def resolution_rad(self) -> float:
        """Angle of one count of the joint's encoder."""
        return 2.0 * np.pi / self.link.config.encoder.counts_per_turn

    def run(self, kind: Kind, positions: Array, torques: Array, window_rad: float, settings: dict[str, float]) -> Trace:
        """Run one motion, keep its recording, return its trace. Raises AnswerIsNo when the bounds forbid it."""
        self._check(positions, torques)
        window_rad = min(window_rad, self.bounds.window_rad)
        rows = self.link.excite(positions.tolist(), torques.tolist(), window_rad)
        self.position_rad += float(positions[-1])
        trace = trace_of(kind, rows, {"resolution_rad": self.resolution_rad, **settings})
        self.traces.append(trace)
        self.keep(rows, trace)
        return trace

    def go_to(self, position_rad: float, gains: tuple[float, float], speed_rad_s: float) -> None:
        """Move the reference to `position_rad` (relative to the start), without recording it."""
        way = position_rad - self.position_rad
        duration_s = max(0.2, 0.5 * np.pi * abs(way) / speed_rad_s)
        t = np.linspace(0.0, 1.0, max(2, round(duration_s / self.period_s)))
        path = way * (0.5 - 0.5 * np.cos(np.pi * t))
        self.link.set_gains(*gains)
        self.link.excite(path.tolist(), np.zeros(len(path)).tolist(), self.bounds.window_rad)
        self.position_rad = position_rad

    def of(self, *kinds: Kind) -> list[Trace]:
        """Traces of these kinds so far."""
        return [trace for trace in self.traces if trace.kind in kinds]

    def _check(self, positions: Sequence[float] | Array, torques: Array) -> None:
        farthest = np.max(np.abs(np.asarray(positions) + self.position_rad - self.bounds.centre_rad))
        if farthest > self.bounds.travel_rad * 1.02:
            raise AnswerIsNo(f"an experiment would travel {farthest:.3g} rad, {self.bounds.travel_rad:.3g} are allowed")
        if np.max(np.abs(torques)) > self.bounds.torque_nm:
            raise AnswerIsNo(
                f"an experiment would need {np.max(np.abs(torques)):.3g} N*m, {self.bounds.torque_nm:.3g} are allowed"
            )
