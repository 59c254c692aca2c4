"""The gain sets of a running axis: which stands behind the serial number in the cycle record, and changes between sets.

Around the loop. The store (servod.formats.gains.store) keeps files; the bank knows what the loop runs now. A set
becomes the store's active one only after the loop has taken it.
"""

from __future__ import annotations

import logging
from collections.abc import Awaitable, Callable, Sequence
from concurrent.futures import Executor, Future
from typing import Any

from servod.common.errors import AnswerIsNo, BadInput, ServodError
from servod.formats.config import AxisConfig
from servod.formats.gains.gain_set import GainSet, require_fit
from servod.formats.gains.store import GainStore, StoredSet
from servod.formats.recording.record import CycleRecord
from servod.runtime.daemon.arguments import GainsActivateArgs, GainsLoadArgs, GainsVerdictArgs
from servod.runtime.daemon.requests import work_of
from servod.runtime.daemon.status import ControllerStatus
from servod.runtime.loop.commands import Op

log = logging.getLogger("servod.gains")

_NO_TRIAL = "no gain set is on trial"
#: Sends a command to the loop; awaited, gives the record that shows it done.
SendOrder = Callable[[Op, Sequence[float]], Awaitable[CycleRecord]]
#: Refuses a set that an axis may not run, by raising BadInput.
Fits = Callable[[GainSet, AxisConfig], None]


class GainBank:
    """The sets that ran since the daemon's start, by serial number."""

    def __init__(self, config: AxisConfig, fits: Fits = require_fit) -> None:
        """Open the store and choose the first set: the one active last, or gains.initial. Raises BadInput.

        A set that this axis may not run any more, whatever the reason, gives way to gains.initial: the configuration
        or the version of servod may have changed since it was activated, and the axis shall start all the same.
        """
        self._config, self._fits = config, fits
        self._store = GainStore(config.gains.directory)
        initial = self._store.load_file(config.gains.initial)
        active = self._active_or(initial)
        fits(active.gains, config)
        log.info("gain set %s version %d (%s)", active.name, active.version, active.gains.law.name)
        if warning := active.gains.certificate_warning():
            log.warning("gain set %s version %d: %s", active.name, active.version, warning)
        self._sets = {0: active}
        self._last_serial = 0
        self._tried: StoredSet | None = None

    @property
    def on_trial(self) -> bool:
        """Whether the set that runs is only tried: the store's active one is another."""
        return self._tried is not None

    @property
    def newest(self) -> StoredSet:
        """The set that was sent to the loop last; before that the one it starts with, as serial 0."""
        return self._sets[self._last_serial]

    def describe(self, serial: int) -> ControllerStatus:
        """The part of the status document."""
        stored = self._sets.get(serial)
        return {
            "serial": serial,
            "name": stored.name if stored else "unknown",
            "law": stored.gains.law.name if stored else "unknown",
        }

    async def load(self, args: GainsLoadArgs, slow: Executor) -> dict[str, Any]:
        """Check and store a set."""
        stored = await work_of(slow.submit(self._store.load, args.text, args.name))
        return _row(stored)

    async def list(self, serial: int, slow: Executor) -> dict[str, Any]:
        """All stored versions, and which one runs."""
        running = self._sets.get(serial)
        now = (running.name, running.version) if running else None
        rows = await work_of(slow.submit(self._rows, now))
        return {"gains": rows}

    def _rows(self, now: tuple[str, int] | None) -> Sequence[dict[str, Any]]:
        """All stored versions: which one runs, and why the axis may not run one (`refused`, else empty)."""
        return [
            {**_row(s), "active": (s.name, s.version) == now, "refused": self._refusal(s)} for s in self._store.stored()
        ]

    def _refusal(self, stored: StoredSet) -> str:
        try:
            require_fit(stored.gains, self._config)
        except BadInput as refusal:
            return str(refusal)
        return ""

    async def activate(self, args: GainsActivateArgs, send: SendOrder, slow: Executor) -> dict[str, Any]:
        """Change the running controller to a stored set, bumpless."""
        stored: StoredSet = await work_of(slow.submit(self._store.get, args.name, args.version))
        await self._deploy(stored, send)
        self._tried = stored if args.trial else None
        if not args.trial:
            await self._write(slow.submit(self._store.activate, stored.name, stored.version), stored, send, slow)
        return _row(stored)

    async def keep(self, args: GainsVerdictArgs, send: SendOrder, slow: Executor) -> dict[str, Any]:
        """Make the set on trial the active one. Where the store cannot be written, the active one runs again."""
        tried, self._tried = self._tried, None  # from here on nobody else ends the trial
        if tried is None:
            raise AnswerIsNo(_NO_TRIAL)
        written = slow.submit(self._store.activate, tried.name, tried.version, args.note, args.figures)
        await self._write(written, tried, send, slow)
        return _row(tried)

    async def rollback(self, args: GainsVerdictArgs, send: SendOrder, slow: Executor) -> dict[str, Any]:
        """Go back to the set that was active before; from a trial, to the one that is."""
        if self._tried is None and args.trial:
            raise AnswerIsNo(_NO_TRIAL)
        if self._tried is not None:
            return await self._reject(self._tried, args, send, slow)
        stored: StoredSet = await work_of(slow.submit(self._store.previous))
        await self._deploy(stored, send)
        await self._write(slow.submit(self._store.rollback), stored, send, slow)
        return _row(stored)

    def _active_or(self, initial: StoredSet) -> StoredSet:
        """The stored active set where the axis may run it; else `initial`, which is active from then on."""
        last = self._store.active_reference()
        if last is None:
            return self._store.activate(initial.name, initial.version)
        try:
            active = self._store.get(last.name, last.version)
            self._fits(active.gains, self._config)
        except BadInput as error:
            log.warning(
                "%s; %s version %d (gains.initial) runs in place of %s version %d. Set back what was changed and "
                "`servoctl gains activate %s`, or make a set anew: `servoctl synthesize`, `verify`, `deploy`",
                *(error, initial.name, initial.version, last.name, last.version, last.name),
            )
            return self._store.activate(initial.name, initial.version, f"in place of {last.name}: {error}")
        return active

    async def _reject(
        self, tried: StoredSet, args: GainsVerdictArgs, send: SendOrder, slow: Executor
    ) -> dict[str, Any]:
        """End a trial: the active set runs again."""
        active = await self._back(send, slow)
        await work_of(slow.submit(self._store.reject, tried.name, tried.version, args.note, args.figures))
        return active

    async def _write(self, written: Future[StoredSet], runs: StoredSet, send: SendOrder, slow: Executor) -> None:
        """Wait until the store has the set that runs as its active one; when it cannot, the active one runs again.

        Should that fail too, the set that runs is on trial, so that whoever leaves or rolls back goes back.
        """
        try:
            await work_of(written)
        except (ServodError, OSError) as error:
            log.error("gain set %s version %d runs and cannot be stored as active: %s", runs.name, runs.version, error)
            self._tried = runs
            await self._back(send, slow)
            raise

    async def _back(self, send: SendOrder, slow: Executor) -> dict[str, Any]:
        """The store's active set runs again, and none is on trial."""
        active: StoredSet | None = await work_of(slow.submit(self._store.active))
        assert active is not None  # the bank activated one when it began
        await self._deploy(active, send)
        self._tried = None
        return _row(active)

    async def _deploy(self, stored: StoredSet, send: SendOrder) -> None:
        """Send a set to the loop and wait until its records show that it runs."""
        self._fits(stored.gains, self._config)
        serial, parameters = self._last_serial + 1, stored.gains.pack()
        await send(Op.ACTIVATE, (serial, stored.gains.law.number, len(parameters), *parameters))
        self._last_serial, self._sets[serial] = serial, stored
        log.info("gain set %s version %d (%s) runs", stored.name, stored.version, stored.gains.law.name)


def _row(stored: StoredSet) -> dict[str, Any]:
    return {
        "name": stored.name,
        "version": stored.version,
        "law": stored.gains.law.name,
        "certified": stored.gains.certificate_problem() is None,
        "sha256": stored.sha256,
        "warning": stored.gains.certificate_warning() or "",
    }
