"""An axis that can be commanded: the one protocol, whatever is behind it.

Between all that works on an axis (experiments, deployment, comparison, faults) and the two ways to it: `stepped` has it
in this process and in virtual time, `under_daemon` reaches it over the control socket. Cycles come as packed records
(servod.formats.recording.record): what is made of them is for those who asked.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

from servod.common.errors import AnswerIsNo
from servod.formats.config import AxisConfig
from servod.formats.gains.gain_set import GainSet
from servod.formats.model.identified import Devices

#: Told at every look at a motion that runs: how many seconds of it have passed.
Watch = Callable[[float], None]
#: In virtual time a motion is looked at so often, unless somebody wants it otherwise.
LOOK_S = 0.1


class AxisDropped(AnswerIsNo):
    """The axis is not enabled any more; `raw` are the cycles of the motion that it dropped out of."""

    def __init__(self, state: str, why: str, raw: bytes = b"") -> None:
        super().__init__(f"the axis went to {state}. {why}")
        self.state, self.why, self.raw = state, why, raw


@dataclass(frozen=True)
class ReferenceMotion:
    """A motion from where the reference stands, in the arguments of the verb `track`."""

    arguments: dict[str, Any]

    @classmethod
    def sine(cls, amplitude_rad: float, frequency_hz: float, duration_s: float) -> ReferenceMotion:
        """A sine."""
        return cls({
            "kind": "sine", "amplitude_rad": amplitude_rad, "frequency_hz": frequency_hz, "duration_s": duration_s,
        })  # fmt: skip

    @classmethod
    def paper(cls, duration_s: float) -> ReferenceMotion:
        """Trajectory (19)."""
        return cls({"kind": "paper", "duration_s": duration_s})

    @classmethod
    def step(cls, amplitude_rad: float, duration_s: float) -> ReferenceMotion:
        """A step that is held."""
        return cls({"kind": "step", "amplitude_rad": amplitude_rad, "duration_s": duration_s})

    @classmethod
    def table(cls, positions_rad: Sequence[float]) -> ReferenceMotion:
        """Positions, one for each cycle, relative to the first."""
        return cls({"kind": "csv", "positions_rad": list(positions_rad)})

    @classmethod
    def excite(cls, positions_rad: Sequence[float], torques_nm: Sequence[float], window_rad: float) -> ReferenceMotion:
        """Positions with torque on top; it ends by itself further than `window_rad` from the reference."""
        return cls({
            "kind": "excite", "positions_rad": list(positions_rad), "torques_nm": list(torques_nm),
            "window_rad": window_rad,
        })  # fmt: skip


class AxisReading(NamedTuple):
    """The axis now; `state` is the name of its servod.runtime.loop.axis_state.AxisState."""

    state: str
    moves: bool
    position_rad: float
    reference_rad: float

    @property
    def enabled(self) -> bool:
        """Whether it holds and takes motions."""
        return self.state == "ENABLED"


class AxisClient(Protocol):
    """An axis with a store of gain sets, under one client that commands it.

    `begin`, `run` and `wait` raise AxisDropped, with the faults and their remedies, when the axis drops out or has done
    so, `enable` AnswerIsNo when it does not get there. In virtual time what is refused raises AnswerIsNo as well; under
    a daemon what is refused on an axis that stays enabled raises Refused, what does not reach it at all Unreachable.
    """

    @property
    def config(self) -> AxisConfig:
        """Limits, period, filter and encoder of the axis."""
        ...

    @property
    def devices(self) -> Devices:
        """Drive and encoder, as far as they say who they are."""
        ...

    @property
    def offset_ns(self) -> int | None:
        """What turns the records' time into the time of day; None where they have the monotonic clock's."""
        ...

    @property
    def active(self) -> tuple[str, int]:
        """Name and version of the set that runs, on trial or not."""
        ...

    def status(self) -> AxisReading:
        """The axis now."""
        ...

    def enable(self, reset_fault: bool = False) -> None:
        """Enable under the set that runs."""
        ...

    def disable(self) -> None:
        """Bring to rest and switch off; never raises."""
        ...

    def stop(self) -> None:
        """Stop at once, whatever runs; never raises."""
        ...

    def load(self, gains: GainSet) -> tuple[str, int]:
        """Put a set into the store; its name and version there."""
        ...

    def activate(self, name: str, version: int) -> None:
        """Change to a stored set on trial, bumpless: what is stored as active stays so."""
        ...

    def keep(self, note: str, figures: dict[str, float]) -> None:
        """Make the set on trial the active one. Raises AnswerIsNo when none is."""
        ...

    def give_up(self, note: str, figures: dict[str, float]) -> None:
        """Change back from the set on trial to the active one. Raises AnswerIsNo when none is."""
        ...

    def begin(self, motion: ReferenceMotion) -> None:
        """Start a motion and let it run."""
        ...

    def run(self, motion: ReferenceMotion, watch: Watch | None = None, look_s: float = LOOK_S) -> bytes:
        """Run a motion to its end; all cycles meanwhile, with some of rest before and behind it.

        In virtual time the axis is looked at every `look_s`: what follows the motion follows it so much later at most.
        AxisDropped brings the cycles until then.
        """
        ...

    def wait(self, duration_s: float) -> None:
        """Let time pass."""
        ...
