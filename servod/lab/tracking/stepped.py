"""Tracking over the whole CAN loop in virtual time: the same cycle, master and nodes as on a real bus.

Stands on the stepped session, which the caller makes, so that every gain set meets the same axis with the same seeds.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from servod.client.stepped import SteppedSession
from servod.common.errors import AnswerIsNo
from servod.formats.gains.gain_set import GainSet
from servod.lab.recordings.recording import ROW
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
from servod.runtime.loop.axis import AxisState
from servod.runtime.loop.commands import REFUSAL_TEXT, Op, ReferenceKind, Refusal

#: Told how much of a measurement is done, from 0 to 1.
Tell = Callable[[float], None]

_SLICE_S = 0.5


def measure(open_session: Callable[[], SteppedSession], gains: GainSet, tell: Tell | None = None) -> Tracking:
    """Activate `gains` on a new session, track (19) for 30 s, then steps of 100 and 10 mrad, each held for 20 s.

    The session may be enabled or not, its controller is replaced. Raises AnswerIsNo when the axis refuses or drops out.
    """
    session = open_session()
    activate(session, gains)
    whole_s = PAPER_S + HOLD_S * len(STEPS_MRAD)
    done_s = 0.0

    def move(kind: ReferenceKind, arguments: Sequence[float], duration_s: float, swing: Swing | None = None) -> Curves:
        nonlocal done_s
        before_s, done_s = done_s, done_s + duration_s
        watch = None if tell is None else lambda seconds: tell((before_s + min(seconds, duration_s)) / whole_s)
        return run_motion(session, kind, arguments, watch, gains.name, swing)

    followed = move(ReferenceKind.PAPER, [PAPER_S], PAPER_S)
    swings = {size: Swing() for size in STEPS_MRAD}
    steps = {size: move(ReferenceKind.STEP, [size * 1e-3, HOLD_S], HOLD_S, swings[size]) for size in STEPS_MRAD}
    widths_rad = {size: swing.width_rad for size, swing in swings.items()}
    count_rad = 2.0 * math.pi / session.config.encoder.counts_per_turn
    return tracking(followed, steps, count_rad, widths_rad, known_noise(gains, count_rad))


class Swing:
    """How far the joint itself moves while a step is held, from HOLD_FROM_S on: what no encoder can tell from noise."""

    def __init__(self) -> None:
        self._lowest, self._highest = math.inf, -math.inf

    @property
    def width_rad(self) -> float:
        """Peak to peak; before HOLD_FROM_S below zero."""
        return self._highest - self._lowest

    def look(self, session: SteppedSession, passed_s: float) -> None:
        """Take the joint's position at `passed_s` after the motion began."""
        if passed_s >= HOLD_FROM_S and session.cycle.reference.active:
            x = session.world.truth().position_rad
            self._lowest, self._highest = min(self._lowest, x), max(self._highest, x)


def activate(session: SteppedSession, gains: GainSet) -> None:
    """Change to `gains`, enable if need be, and rest until the change has faded out. Raises AnswerIsNo."""
    parameters = gains.pack()
    _must(session.send(Op.ACTIVATE, [0, gains.law.number, len(parameters), *parameters]))
    if session.cycle.axis.state != AxisState.ENABLED:
        session.enable()
    session.run(REST_S)


def run_motion(
    session: SteppedSession,
    kind: ReferenceKind,
    arguments: Sequence[float],
    tell: Tell | None = None,
    name: str = "the gain set",
    swing: Swing | None = None,
) -> Curves:
    """One motion from its first cycle to its last; `tell` gets the seconds that have passed, `swing` looks on.

    Raises AnswerIsNo when it is refused or the axis drops out; `name` says under what.
    """
    start_rad = session.cycle.reference.position_rad
    session.clear()
    begin(session, kind, arguments)
    follow(session, tell, name, swing)
    return curves_of(session.raw, start_rad)


def begin(session: SteppedSession, kind: ReferenceKind, arguments: Sequence[float]) -> None:
    """Start a motion. Raises AnswerIsNo when it is refused."""
    _must(session.send(Op.REFERENCE, [kind, *arguments]))


def follow(
    session: SteppedSession, tell: Tell | None = None, name: str = "the gain set", swing: Swing | None = None
) -> None:
    """Run until the motion is over; `tell` gets the seconds that have passed, `swing` looks on.

    Raises AnswerIsNo when the axis drops out; `name` says under what.
    """
    passed_s = 0.0
    while session.cycle.reference.active:
        _pass(session, passed_s, swing)
        passed_s += _SLICE_S
        if tell:
            tell(passed_s)
    if session.cycle.axis.state != AxisState.ENABLED:
        raise AnswerIsNo(f"the axis went to {session.cycle.axis.state.name} under {name}. {session.why}")


def _pass(session: SteppedSession, passed_s: float, swing: Swing | None) -> None:
    """One slice of time, with a look at the joint in every cycle: a slower look misses cycles of its own multiples."""
    if swing is None:
        session.run(_SLICE_S)
        return
    period_s = session.cycle.period_ns * 1e-9
    for look in range(1, round(_SLICE_S / period_s) + 1):
        session.run(period_s)
        swing.look(session, passed_s + look * period_s)


def curves_of(raw: bytes, start_rad: float) -> Curves:
    """The cycles of `raw` (packed records) in which a reference motion ran, positions relative to `start_rad`."""
    rows = np.frombuffer(raw, dtype=ROW)
    rows = rows[rows["reference_active"] == 1]
    return Curves(
        time_s=(rows["time_ns"] - rows["time_ns"][0]) * 1e-9,
        reference_rad=rows["reference_rad"] - start_rad,
        position_rad=rows["position_rad"] - start_rad,
        torque_nm=rows["torque_nm"].copy(),
        feedback_nm=rows["torque_feedback_nm"].copy(),
        friction_nm=rows["torque_friction_nm"].copy(),
        other_nm=rows["torque_other_nm"].copy(),
    )


def _must(refusal: Refusal) -> None:
    if refusal != Refusal.DONE:
        raise AnswerIsNo(REFUSAL_TEXT[refusal])
