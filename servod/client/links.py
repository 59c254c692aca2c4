"""The axis that a set is tried on: a small protocol, and the SYNC-stepped axis behind it.

Under the deployment; `daemon_link` has the same for an axis under a running daemon.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from servod.client.stepped import SteppedSession
from servod.common.errors import AnswerIsNo
from servod.formats.config import AxisConfig
from servod.formats.gains.gain_set import GainSet
from servod.formats.gains.store import GainStore, StoredSet
from servod.formats.recording.record import RECORD
from servod.lab.recordings.rows import ROW
from servod.lab.verify.validation import STEP_S, ValidationMotion
from servod.runtime.loop.axis import AxisState
from servod.runtime.loop.commands import REFUSAL_TEXT, Op, ReferenceKind, Refusal

Rows = NDArray[np.void]
#: Told how far a motion is, from 0 to 1.
Tell = Callable[[float], None]

#: After a change of the set, until its offset has faded out.
FADE_S = 1.0
_SLICE_S = 0.25
#: The sines may be short by so many cycles at their ends and still be whole: a record of the first may be late.
_CUT_CYCLES = 50


class DeployLink(Protocol):
    """An axis with a store of gain sets.

    `attempt` and `run` raise AnswerIsNo when the axis drops out: that is an answer to the set that runs. Under a daemon
    what is refused on an axis that stays enabled, and what does not reach it at all, raises Unreachable.
    """

    @property
    def config(self) -> AxisConfig:
        """Limits, period, filter and encoder of the axis."""
        ...

    @property
    def active(self) -> tuple[str, int]:
        """Name and version of the set that runs."""
        ...

    @property
    def enabled(self) -> bool:
        """Whether the axis is enabled."""
        ...

    def enable(self) -> None:
        """Enable under the active set."""
        ...

    def disable(self) -> None:
        """Bring to rest and switch off; never raises."""
        ...

    def stop(self) -> None:
        """Stop at once, whatever runs; never raises."""
        ...

    def run(self, motion: ValidationMotion, window_rad: float, tell: Tell) -> Rows:
        """Run the motion from where the axis stands; all its cycles.

        The sines end when the joint is further than `window_rad` from the reference. Nothing follows them then: a law
        that lost the joint on a sine is given no step.
        """
        ...

    def load(self, gains: GainSet) -> tuple[str, int]:
        """Put a set into the store; its name and version there."""
        ...

    def attempt(self, name: str, version: int) -> None:
        """Change to a stored set on trial: what is stored as active stays so. Back when its offset has faded out."""
        ...

    def keep(self, note: str, figures: dict[str, float]) -> None:
        """Make the set on trial the active one."""
        ...

    def give_up(self, note: str, figures: dict[str, float]) -> None:
        """Change back to the active set; nothing where no set is on trial."""
        ...


class SteppedDeployLink:
    """The virtual axis in virtual time, with a store in a folder; `present` runs when the store has none active."""

    def __init__(self, session: SteppedSession, store: GainStore, present: GainSet) -> None:
        self.session, self._store = session, store
        if store.active() is None:
            stored = store.load(present.to_yaml(), present.name)
            store.activate(stored.name, stored.version)
        self._serial = 0
        self._tried: StoredSet | None = None
        self._change(self._active())

    @property
    def config(self) -> AxisConfig:
        """The session's configuration."""
        return self.session.config

    @property
    def active(self) -> tuple[str, int]:
        """The set on trial, or the store's active one."""
        stored = self._tried or self._active()
        return stored.name, stored.version

    @property
    def enabled(self) -> bool:
        """Whether the axis is enabled."""
        return self.session.cycle.axis.state == AxisState.ENABLED

    def enable(self) -> None:
        """Enable, and let what is held come to rest."""
        self.session.enable()
        self.session.run(FADE_S)

    def disable(self) -> None:
        """Ramp down and let the drive see it."""
        self._off(Op.DISABLE)

    def stop(self) -> None:
        """The drive's quick stop."""
        self._off(Op.QUICK_STOP)

    def run(self, motion: ValidationMotion, window_rad: float, tell: Tell) -> Rows:
        """Run the motion as fast as it computes."""
        self._must_be_enabled()
        session, sines = self.session, motion.sines.tolist()
        session.clear()
        session.load_trajectory([*sines, *[0.0] * len(sines)])
        self._move(ReferenceKind.EXCITE, [len(sines), min(sines), max(sines), window_rad], tell, motion)
        if cut(np.frombuffer(session.raw, dtype=ROW), motion):
            return np.frombuffer(session.raw, dtype=ROW)
        for step_rad in (motion.step_rad, -motion.step_rad):
            self._move(ReferenceKind.STEP, [step_rad, STEP_S], tell, motion)
        return np.frombuffer(session.raw, dtype=ROW)

    def load(self, gains: GainSet) -> tuple[str, int]:
        """Put a set into the store."""
        stored = self._store.load(gains.to_yaml(), gains.name)
        return stored.name, stored.version

    def attempt(self, name: str, version: int) -> None:
        """Change to the set in the loop alone."""
        self._tried = self._store.get(name, version)
        self._change(self._tried)
        self.session.run(FADE_S)
        self._must_be_enabled()

    def keep(self, note: str, figures: dict[str, float]) -> None:
        """Make the set on trial the store's active one."""
        tried = self._tried
        assert tried is not None  # `attempt` came before
        self._store.activate(tried.name, tried.version, note, figures)
        self._tried = None

    def give_up(self, note: str, figures: dict[str, float]) -> None:
        """The store's active set runs again."""
        tried, self._tried = self._tried, None
        if tried is None:
            return
        self._change(self._active())
        self._store.reject(tried.name, tried.version, note, figures)

    def _active(self) -> StoredSet:
        stored = self._store.active()
        assert stored is not None  # from the beginning on
        return stored

    def _change(self, stored: StoredSet) -> None:
        self._serial += 1
        parameters = stored.gains.pack()
        _must(self.session.send(Op.ACTIVATE, [self._serial, stored.gains.law.number, len(parameters), *parameters]))

    def _move(self, kind: ReferenceKind, arguments: Sequence[float], tell: Tell, motion: ValidationMotion) -> None:
        session = self.session
        _must(session.send(Op.REFERENCE, [kind, *arguments]))
        while session.cycle.reference.active:
            session.run(_SLICE_S)
            tell(min(1.0, len(session.raw) // RECORD.size * motion.period_s / motion.duration_s))
        self._must_be_enabled()

    def _must_be_enabled(self) -> None:
        state = self.session.cycle.axis.state
        if state != AxisState.ENABLED:
            raise AnswerIsNo(f"the axis went to {state.name}. {self.session.why}")

    def _off(self, op: Op) -> None:
        with contextlib.suppress(AnswerIsNo):
            self.session.send(op)
            self.session.run(self.config.limits.ramp_down_s + 0.1)


def cut(rows: Rows, motion: ValidationMotion) -> bool:
    """Whether the reference of `rows`, which hold the sines alone, ended before the sines did."""
    ran = rows["cycle"][rows["reference_active"] == 1]
    return len(ran) == 0 or int(ran[-1]) - int(ran[0]) < len(motion.sines) - _CUT_CYCLES


def _must(refusal: Refusal) -> None:
    if refusal != Refusal.DONE:
        raise AnswerIsNo(f"the axis refused: {REFUSAL_TEXT[refusal]}")
