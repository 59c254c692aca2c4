"""Tracking over the whole CAN loop: the same cycle, master and nodes as on a real bus.

Stands on an axis that the caller opens: in virtual time, so that every gain set meets the same axis with the same
seeds, or under a daemon.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

from servod.client.axis import AxisClient, AxisDropped, ReferenceMotion
from servod.client.stepped import SteppedAxis
from servod.common.errors import AnswerIsNo
from servod.common.progress import OnShare
from servod.formats.gains.gain_set import GainSet
from servod.lab.recordings.recording import moving, rows_of
from servod.lab.tracking.metrics import (
    HOLD_FROM_S,
    HOLD_S,
    PAPER_S,
    REST_S,
    STEPS_MRAD,
    Curves,
    Tracking,
    known_noise,
    tracking,
)

_LOOK_S = 0.5


def measure(open_axis: Callable[[], SteppedAxis], gains: GainSet, on_progress: OnShare | None = None) -> Tracking:
    """Activate `gains` on a new axis, track (19) for 30 s, then steps of 100 and 10 mrad, each held for 20 s.

    The axis may be enabled or not, its controller is replaced. Raises AnswerIsNo when the axis refuses or drops out.
    """
    axis = open_axis()
    activate(axis, gains)
    whole_s = PAPER_S + HOLD_S * len(STEPS_MRAD)
    done_s = 0.0

    def move(motion: ReferenceMotion, duration_s: float, swing: Swing | None = None) -> Curves:
        nonlocal done_s
        before_s, done_s = done_s, done_s + duration_s
        watch = (
            None
            if on_progress is None
            else lambda seconds: on_progress((before_s + min(seconds, duration_s)) / whole_s)
        )
        return run_motion(axis, motion, watch, gains.name, swing)

    followed = move(ReferenceMotion.paper(PAPER_S), PAPER_S)
    swings = {size: Swing() for size in STEPS_MRAD}
    steps = {size: move(ReferenceMotion.step(size * 1e-3, HOLD_S), HOLD_S, swings[size]) for size in STEPS_MRAD}
    widths_rad = {size: swing.width_rad for size, swing in swings.items()}
    count_rad = 2.0 * math.pi / axis.config.encoder.counts_per_turn
    return tracking(followed, steps, count_rad, widths_rad, known_noise(gains, count_rad))


class Swing:
    """How far the joint itself moves while a step is held, from HOLD_FROM_S on: what no encoder can tell from noise."""

    def __init__(self) -> None:
        self._lowest, self._highest = math.inf, -math.inf

    @property
    def width_rad(self) -> float:
        """Peak to peak; before HOLD_FROM_S below zero."""
        return self._highest - self._lowest

    def look(self, axis: SteppedAxis, passed_s: float) -> None:
        """Take the joint's position at `passed_s` after the motion began."""
        if passed_s >= HOLD_FROM_S and axis.status().moves:
            x = axis.truth().position_rad
            self._lowest, self._highest = min(self._lowest, x), max(self._highest, x)


def activate(axis: AxisClient, gains: GainSet) -> None:
    """Change to `gains`, enable if need be, and rest until the change has faded out. Raises AnswerIsNo."""
    axis.activate(*axis.load(gains))
    if not axis.status().enabled:
        axis.enable()
    axis.wait(REST_S)


def run_motion(
    axis: SteppedAxis,
    motion: ReferenceMotion,
    on_progress: OnShare | None = None,
    name: str = "the gain set",
    swing: Swing | None = None,
) -> Curves:
    """One motion from its first cycle to its last; `on_progress` gets the seconds that have passed, `swing` looks on.

    Every cycle is looked at: a slower look misses cycles of its own multiples. Raises AnswerIsNo when the motion is
    refused or the axis drops out; `name` says under what.
    """
    start_rad = axis.status().reference_rad
    each_cycle = None if swing is None else partial(swing.look, axis)
    try:
        return curves_of(axis.run(motion, on_progress, _LOOK_S, each_cycle), start_rad)
    except AxisDropped as dropped:
        raise AnswerIsNo(f"the axis went to {dropped.state} under {name}. {dropped.why}") from None


def curves_of(raw: bytes, start_rad: float) -> Curves:
    """The cycles of `raw` (packed records) in which a reference motion ran, positions relative to `start_rad`."""
    rows = moving(rows_of(raw))
    return Curves(
        time_s=(rows["time_ns"] - rows["time_ns"][0]) * 1e-9,
        reference_rad=rows["reference_rad"] - start_rad,
        position_rad=rows["position_rad"] - start_rad,
        torque_nm=rows["torque_nm"].copy(),
        feedback_nm=rows["torque_feedback_nm"].copy(),
        friction_nm=rows["torque_friction_nm"].copy(),
        other_nm=rows["torque_other_nm"].copy(),
    )
