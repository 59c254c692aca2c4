"""Sees each fault once: log line with cause, remedy and health, event in the recording, and the pre-fault file.

Around the loop. The reaction was the loop's, in the cycle of the fault; this only tells people.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from concurrent.futures import Future
from pathlib import Path
from typing import Any

from servod.common.faults import FAULTS, Fault, FaultCode, Reaction, faults_in
from servod.common.units import NS_PER_S
from servod.formats.recording.incidents import Incident, Seen
from servod.formats.recording.mcap_writer import wall_offset_ns
from servod.formats.recording.record import CycleRecord
from servod.runtime.daemon.health import Health
from servod.runtime.daemon.metrics import AxisMetrics
from servod.runtime.daemon.recorder import Recorder
from servod.runtime.daemon.status import WiringStatus
from servod.runtime.loop.axis_state import AxisState
from servod.runtime.loop.handle import LoopHandle
from servod.runtime.loop.wiring.findings import WiringOutcome, wiring_document, wiring_sentence

log = logging.getLogger("servod.faults")

#: The fault file is written this long after the fault, so that it shows the reaction too.
_AFTER_FAULT_NS = NS_PER_S // 2
#: What is kept of the past in memory.
_MOST_INCIDENTS = 50
_LEVEL = {Reaction.NONE: logging.WARNING, Reaction.CLIP: logging.WARNING}


def memory_of_incidents() -> deque[Incident]:
    """Of one daemon; fault files reach farther back."""
    return deque(maxlen=_MOST_INCIDENTS)


class FaultWatch:
    """Edge detector over the records' fault words."""

    def __init__(
        self,
        recorder: Recorder,
        health: Health,
        metrics: AxisMetrics,
        axis: str = "",
        incidents: deque[Incident] | None = None,
        known: int = 0,
    ) -> None:
        """`incidents` is the daemon's memory, where it is older than this watch; the faults `known` were told."""
        self._recorder, self._health, self._metrics, self._axis = recorder, health, metrics, axis
        self._incidents = memory_of_incidents() if incidents is None else incidents
        self._begins = True
        self._offset_ns = wall_offset_ns()
        self._known = known
        self._state = int(AxisState.DISABLED)
        self._file_due_ns, self._file_label = 0, ""
        self._files: list[tuple[Future[Path], Incident | None]] = []

    def see(self, records: list[CycleRecord], now_ns: int) -> None:
        """Report faults that were not there before; an enable makes them new again."""
        for record in records:
            word = record.faults | record.faults_latched
            if record.axis_state != self._state:
                if record.axis_state == AxisState.ENABLING:
                    self._known &= word
                    self._begins = True
                self._state = record.axis_state
            if word & ~self._known:
                self._report(word & ~self._known, record.time_ns, now_ns)
                self._known |= word

    def incidents(self) -> list[dict[str, Any]]:
        """What befell the axis since the start, oldest first."""
        return [incident.document() for incident in self._incidents]

    def _note(self, code: FaultCode, time_ns: int, detail: str = "") -> None:
        """Into the incident that goes on, or a new one; `time_ns` is CLOCK_MONOTONIC."""
        seen = Seen(time_ns + self._offset_ns, code, detail)
        if self._begins or not self._incidents[-1].goes_on(seen.time_ns):
            self._incidents.append(Incident(self._axis))
            self._begins = False
        self._incidents[-1].add(seen)

    def _report(self, word: int, time_ns: int, now_ns: int) -> None:
        for fault in faults_in(word):
            self._note(fault.code, time_ns)
            self.log_fault(fault)
            if fault.reaction > Reaction.CLIP and not self._file_due_ns:
                self._file_due_ns, self._file_label = now_ns + _AFTER_FAULT_NS, fault.code.name

    def raise_own(self, code: FaultCode, detail: str) -> None:
        """A fault that the supervisor found itself."""
        self._metrics.count_fault(code)
        self._note(code, time.monotonic_ns(), detail)
        self.log_fault(FAULTS[code], detail)

    def add_earlier(self, incident: Incident) -> None:
        """What befell the axis before this start, and was found at it."""
        self._incidents.append(incident)
        fault = FAULTS[incident.first.code]
        self._metrics.count_fault(fault.code)
        text = f"{fault.cause} [{incident.first.detail}] {fault.remedy}"
        self._recorder.add_event("fault", text, code=fault.code.name, reaction=fault.reaction.name)

    def log_fault(self, fault: Fault, detail: str = "") -> None:
        """Log line and event of one fault, with the health of loop and bus beside it."""
        more = f" [{detail}]" if detail else ""
        text = f"{fault.cause}{more} {fault.remedy}"
        level = _LEVEL.get(fault.reaction, logging.ERROR)
        log.log(level, "fault %s (%s): %s | %s", fault.code.name, fault.reaction.name, text, self._health.line())
        self._recorder.add_event("fault", text, code=fault.code.name, reaction=fault.reaction.name)

    def tick(self, now_ns: int) -> None:
        """Write the fault file when it is due, and say where it stands."""
        if self._file_due_ns and now_ns >= self._file_due_ns:
            self.write_file(self._file_label)
            self._file_due_ns = 0
        for future, incident in [entry for entry in self._files if entry[0].done()]:
            self._files.remove((future, incident))
            if error := future.exception():
                self.raise_own(FaultCode.RECORDER_FAILED, str(error))
            else:
                log.warning("the seconds before the fault are in %s", future.result())
                if incident is not None:
                    incident.file = str(future.result())

    def write_file(self, label: str) -> None:
        """Hand the history to the recorder's thread."""
        incident = self._incidents[-1] if self._incidents else None
        self._files.append((self._recorder.write_fault_file(label), incident))

    def finish(self) -> None:
        """Write a file that is still due, at the end of the daemon."""
        if self._file_due_ns:
            self.write_file(self._file_label)
            self._file_due_ns = 0


# --- The test of the wiring ------------------------------------------------------------------------------------------
# Tells how each test of the wiring ended: a line in the journal, an event in the recording, a part of the status. The
# table of faults has no room for what was measured.


wiring_log = logging.getLogger("servod.wiring")


class WiringTestWatch:
    """Looks whether another test has ended; `see` once per round."""

    def __init__(self, loop: LoopHandle, recorder: Recorder) -> None:
        self._loop, self._recorder = loop, recorder
        self._reported = 0

    def see(self) -> None:
        """Tell of a test that ended since the last call."""
        count, proof = self._loop.proofs
        if proof is None or count == self._reported:
            return
        self._reported = count
        text = wiring_sentence(proof)
        wiring_log.log(logging.INFO if proof.passed else logging.ERROR, "%s", text)
        self._recorder.add_event("wiring", text, finding=WiringOutcome(int(proof.finding)).name)

    def status(self) -> WiringStatus:
        """How many tests there were since the start, and how the last one ended."""
        count, proof = self._loop.proofs
        return {"tests": count, "last": None if proof is None else wiring_document(proof)}
