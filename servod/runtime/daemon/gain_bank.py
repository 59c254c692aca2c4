"""The gain sets of a running axis: which stands behind the serial number in the cycle record, and changes between sets.

Around the loop. The store (servod.formats.gains.store) keeps files; the bank knows what the loop runs now. A set
becomes the store's active one only after the loop has taken it.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Awaitable, Callable, Sequence
from concurrent.futures import Executor, Future
from typing import Any

from servod.common.errors import AnswerIsNo, BadInput, ServodError, Unreachable
from servod.common.files import unwritable
from servod.formats.config import AxisConfig
from servod.formats.gains.gain_set import GainSet, of_others, parse_gains, require_devices, require_fit, require_signed
from servod.formats.gains.store import GainStore, StoredSet
from servod.formats.model.identified import Devices
from servod.formats.recording.record import CycleRecord
from servod.runtime.daemon.arguments import GainsActivateArgs, GainsLoadArgs, GainsVerdictArgs
from servod.runtime.daemon.requests import LoopTimeout, work_of
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

    def __init__(self, config: AxisConfig, fits: Fits = require_fit, begins: bool = True) -> None:
        """Open the store and choose the first set: the one active last, or gains.initial. Raises BadInput.

        A set that this axis may not run any more, whatever the reason, gives way to gains.initial: the configuration
        or the version of servod may have changed since it was activated, or its file on the disk, and the axis shall
        start all the same. `note` says so, until somebody activates a set. Unless it `begins`, the store's active set
        stays as it is until `begin`.
        """
        self._config, self._fits, self._note = config, fits, ""
        self._devices: Devices | None = None
        self._why_first: str | None = None  # the first set is not the store's active one yet
        self._store = GainStore(config.gains.directory, config.gains.max_versions, mends=begins)
        try:
            initial = self._store.load_file(config.gains.initial)
            active = self._active_or(initial)
        except OSError as error:
            raise unwritable(f"gain store {config.gains.directory}", error) from None
        fits(active.gains, config)
        log.info("gain set %s version %d (%s)", active.name, active.version, active.gains.law.name)
        if warning := active.gains.certificate_warning():
            log.warning("gain set %s version %d: %s", active.name, active.version, warning)
        self._sets = {0: active}
        self._last_serial = self._running = 0
        self._kept = active  # what the store has as the active set, as far as it could be written
        self._tried: StoredSet | None = None
        if begins:
            self.begin()

    def begin(self) -> None:
        """Make the first set the store's active one: the axis runs with it. Raises BadInput."""
        try:
            self._store.mend()
            if self._why_first is not None:
                self._store.activate(self._kept.name, self._kept.version, self._why_first)
        except OSError as error:
            raise unwritable(f"gain store {self._config.gains.directory}", error) from None

    def know(self, devices: Devices) -> None:
        """Drive and encoder of the axis, before its loop starts: a first set of others gives way to gains.initial.

        Where that is of others too, or may not run for another reason, the axis is not enabled; where any set is
        accepted, it runs. Raises BadInput.
        """
        self._devices = devices
        if (error := of_others(self.newest.gains, devices)) is None:
            return
        accepted, initial = self._config.gains.accept_uncertified, self._store.load_file(self._config.gains.initial)
        if accepted:
            said = f"gains.accept_uncertified lets a set of other devices run: {error}"
        elif not self._may_run(initial):
            said = f"the axis is not enabled: {error}"
        else:
            self._sets, self._kept = {0: initial}, initial
            self._why_first = f"in place of {error}"
            said = f"{error}; {initial.name} version {initial.version} (gains.initial) runs in its place"
        self._note = "; ".join(filter(None, (self._note, said)))
        log.warning("%s", said)

    def _may_run(self, stored: StoredSet) -> bool:
        try:
            self._fits(stored.gains, self._config)
            self._require_devices(stored.gains)
        except BadInput:
            return False
        return True

    def require_own_devices(self) -> None:
        """Refuse the set that runs where it was made for another drive or encoder. Raises BadInput."""
        self._require_devices(self.newest.gains)

    def _require_devices(self, gains: GainSet) -> None:
        if self._devices is not None:
            require_devices(gains, self._devices, self._config)

    @property
    def on_trial(self) -> bool:
        """Whether the set that runs is only tried: the store's active one is another."""
        return self._tried is not None

    @property
    def newest(self) -> StoredSet:
        """The set that the loop took last; before that the one it starts with, as serial 0."""
        return self._sets[self._running]

    def gains_of(self, serial: int) -> GainSet | None:
        """The set behind a serial number of the cycle record."""
        stored = self._sets.get(serial)
        return stored.gains if stored else None

    def describe(self, serial: int) -> ControllerStatus:
        """The part of the status document."""
        stored = self._sets.get(serial)
        return {
            "serial": serial,
            "name": stored.name if stored else "unknown",
            "law": stored.gains.law.name if stored else "unknown",
            "note": self._note,
        }

    async def load(self, args: GainsLoadArgs, slow: Executor) -> dict[str, Any]:
        """Check and store a set; where the configuration names signers, only one that they have signed."""
        stored: StoredSet = await work_of(slow.submit(self._load, args))
        return {**_row(stored), "sealed": stored.text != args.text}

    def _load(self, args: GainsLoadArgs) -> StoredSet:
        if self._config.gains.signers:
            require_signed(parse_gains(args.text, args.name), self._config, args.name)
        return self._store.load(args.text, args.name)

    async def list(self, serial: int, slow: Executor) -> dict[str, Any]:
        """All stored versions, and which one runs."""
        running = self._sets.get(serial)
        now = (running.name, running.version) if running else None
        rows = await work_of(slow.submit(self._rows, now))
        return {"gains": rows}

    def _rows(self, now: tuple[str, int] | None) -> Sequence[dict[str, Any]]:
        """All stored versions: which one runs, and why the axis may not run one (`refused`, else empty)."""
        return [{**self._row_of(*one), "active": one == now} for one in self._store.versions()]

    def _row_of(self, name: str, version: int) -> dict[str, Any]:
        """One version, also one whose file is damaged."""
        row = {"name": name, "version": version, "law": "unknown", "certified": False, "sha256": "", "warning": ""}
        try:
            stored = self._store.get(name, version)
            row = _row(stored)
            require_fit(stored.gains, self._config)
            self._require_devices(stored.gains)
        except BadInput as refusal:
            return {**row, "refused": str(refusal)}
        return {**row, "refused": ""}

    async def activate(self, args: GainsActivateArgs, send: SendOrder, slow: Executor) -> dict[str, Any]:
        """Change the running controller to a stored set, bumpless."""
        stored: StoredSet = await work_of(slow.submit(self._store.get, args.name, args.version))
        self._require_devices(stored.gains)
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
        stored = await work_of(slow.submit(self._store.previous))
        self._require_devices(stored.gains)
        await self._deploy(stored, send)
        await self._write(slow.submit(self._store.rollback), stored, send, slow)
        return _row(stored)

    def _active_or(self, initial: StoredSet) -> StoredSet:
        """The stored active set where the axis may run it; else `initial`, which is active from `begin` on."""
        wanted, remedy = (
            "the set that was active",
            "`servoctl gains list` and `servoctl gains activate` the one that is meant",
        )
        try:
            last = self._store.active_reference()
            if last is None:
                self._why_first = ""
                return initial
            wanted = f"{last.name} version {last.version}"
            remedy = (
                f"Set back what was changed and `servoctl gains activate {last.name}`, or make a set again: "
                "`servoctl synthesize`, `verify`, `deploy`"
            )
            active = self._store.get(last.name, last.version)
            self._fits(active.gains, self._config)
        except BadInput as error:
            substitution = f"{initial.name} version {initial.version} (gains.initial) runs in place of {wanted}"
            self._note = f"{error}; {substitution}. {remedy}"
            log.warning("%s", self._note)
            self._why_first = f"in place of {wanted}: {error}"
            return initial
        self._note = self._store.damage
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
        self._kept, self._note = runs, ""

    async def _back(self, send: SendOrder, slow: Executor) -> dict[str, Any]:
        """The active set runs again, and none is on trial: the one in memory, whatever became of the store."""
        active = self._kept
        try:
            self._require_devices(active.gains)
        except BadInput:
            await send(Op.QUICK_STOP, ())  # an axis that is off may have it, and no other
        await self._deploy(active, send)
        self._tried = None
        last = await work_of(slow.submit(self._stored_as_active))
        if last != (active.name, active.version):  # a write that failed half-way, or a file that was damaged since
            await work_of(slow.submit(self._store.activate, active.name, active.version, "runs again"))
        return _row(active)

    def _stored_as_active(self) -> tuple[str, int] | None:
        with contextlib.suppress(BadInput):
            if last := self._store.active_reference():
                return last.name, last.version
        return None

    async def _deploy(self, stored: StoredSet, send: SendOrder) -> None:
        """Send a set to the loop and wait until its records show that it runs.

        A loop that does not answer may take it yet: then the set that runs now is sent behind it, so that what was
        refused does not run in the end.
        """
        self._fits(stored.gains, self._config)
        before = self.newest
        try:
            await self._send(stored, send)
        except LoopTimeout:
            log.error("the loop did not answer; gain set %s version %d is sent again", before.name, before.version)
            with contextlib.suppress(Unreachable):  # it takes both, in this order, or none
                await self._send(before, send)
            self._running = self._last_serial
            raise
        log.info("gain set %s version %d (%s) runs", stored.name, stored.version, stored.gains.law.name)

    async def _send(self, stored: StoredSet, send: SendOrder) -> None:
        self._last_serial = serial = self._last_serial + 1
        self._sets[serial] = stored  # known before it runs: the answer may be missed
        parameters = stored.gains.pack()
        await send(Op.ACTIVATE, (serial, stored.gains.law.number, len(parameters), *parameters))
        self._running = serial


def _row(stored: StoredSet) -> dict[str, Any]:
    return {
        "name": stored.name,
        "version": stored.version,
        "law": stored.gains.law.name,
        "certified": stored.gains.certificate_problem() is None,
        "sha256": stored.sha256,
        "warning": stored.gains.certificate_warning() or "",
    }
