"""How experiments reach an axis: the small protocol, and the SYNC-stepped virtual axis behind it.

Above the session; `daemon_link` has the same for a running daemon. An experiment says gains, positions and torques, and
gets the recorded cycles of its motion back.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from servod.common.errors import AnswerIsNo
from servod.common.faults import faults_in
from servod.formats.config import AxisConfig
from servod.formats.recording.record import CycleRecord
from servod.lab.identify.trace import Trace
from servod.runtime.loop.axis import AxisState

#: Told after every slice of a motion: how many seconds of it have passed.
Watch = Callable[[float], None]


class MotionEnded(AnswerIsNo):
    """The axis dropped out of a motion; `rows` are its cycles, and `trace` what an experiment made of them."""

    def __init__(self, message: str, rows: NDArray[np.void]) -> None:
        super().__init__(message)
        self.rows = rows
        self.trace: Trace | None = None


class Link(Protocol):
    """An axis that experiments may move. Every method raises AnswerIsNo when the axis drops out or refuses."""

    @property
    def config(self) -> AxisConfig:
        """Limits, period and encoder of the axis."""
        ...

    @property
    def offset_ns(self) -> int | None:
        """What turns the records' time into the time of day; None where they have the monotonic clock's."""
        ...

    def enable(self) -> float:
        """Enable under no torque; returns the present position in rad."""
        ...

    def set_gains(self, position_nm_per_rad: float, velocity_nms_per_rad: float) -> None:
        """Change the PD feedback under which motions run; bumpless."""
        ...

    def excite(
        self, positions_rad: Sequence[float], torques_nm: Sequence[float], window_rad: float
    ) -> NDArray[np.void]:
        """Run a motion relative to the present reference with torque on top; returns its cycles.

        It ends by itself when the joint is further than `window_rad` from the reference. Raises MotionEnded when the
        axis drops out.
        """
        ...

    def disable(self) -> None:
        """Ramp the torque down and switch off; never raises."""
        ...


def moving(rows: NDArray[np.void]) -> NDArray[np.void]:
    """The cycles of the motion."""
    active: NDArray[np.void] = rows[rows["reference_active"] == 1]
    return active


def check_state(record: CycleRecord) -> None:
    """Raise AnswerIsNo, with the faults and their remedies, when the axis is not enabled any more."""
    if record.axis_state == AxisState.ENABLED:
        return
    why = "; ".join(f"{f.code.name}: {f.cause} {f.remedy}" for f in faults_in(record.faults_latched))
    raise AnswerIsNo(f"the experiment ended with the axis in {AxisState(record.axis_state).name}. {why}")
