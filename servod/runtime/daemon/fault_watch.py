"""Sees each fault once: log line with cause, remedy and health, event in the recording, and the pre-fault file.

Around the loop. The reaction was the loop's, in the cycle of the fault; this only tells people.
"""

from __future__ import annotations

import logging
from concurrent.futures import Future
from pathlib import Path

from servod.common.faults import FAULTS, Fault, FaultCode, Reaction, faults_in
from servod.common.units import NS_PER_S
from servod.formats.recording.record import CycleRecord
from servod.runtime.daemon.health import Health
from servod.runtime.daemon.metrics import AxisMetrics
from servod.runtime.daemon.recorder import Recorder
from servod.runtime.daemon.status import WiringStatus
from servod.runtime.loop.axis import AxisState
from servod.runtime.loop.handle import LoopHandle
from servod.runtime.loop.wiring.findings import Finding, document, sentence

log = logging.getLogger("servod.faults")

#: The fault file is written this long after the fault, so that it shows the reaction too.
_AFTER_FAULT_NS = NS_PER_S // 2
_LEVEL = {Reaction.NONE: logging.WARNING, Reaction.CLIP: logging.WARNING}


class FaultWatch:
    """Edge detector over the records' fault words."""

    def __init__(self, recorder: Recorder, health: Health, metrics: AxisMetrics) -> None:
        self._recorder, self._health, self._metrics = recorder, health, metrics
        self._known = 0
        self._state = int(AxisState.DISABLED)
        self._file_due_ns, self._file_label = 0, ""
        self._files: list[Future[Path]] = []

    def see(self, records: list[CycleRecord], now_ns: int) -> None:
        """Report faults that were not there before; an enable makes them new again."""
        for record in records:
            word = record.faults | record.faults_latched
            if record.axis_state != self._state:
                if record.axis_state == AxisState.ENABLING:
                    self._known &= word
                self._state = record.axis_state
            if word & ~self._known:
                self._report(word & ~self._known, now_ns)
                self._known |= word

    def _report(self, word: int, now_ns: int) -> None:
        for fault in faults_in(word):
            self.tell(fault)
            if fault.reaction > Reaction.CLIP and not self._file_due_ns:
                self._file_due_ns, self._file_label = now_ns + _AFTER_FAULT_NS, fault.code.name

    def raise_own(self, code: FaultCode, detail: str) -> None:
        """A fault that the supervisor found itself."""
        self._metrics.count_fault(code)
        self.tell(FAULTS[code], detail)

    def tell(self, fault: Fault, detail: str = "") -> None:
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
        for future in [f for f in self._files if f.done()]:
            self._files.remove(future)
            if error := future.exception():
                self.raise_own(FaultCode.RECORDER_FAILED, str(error))
            else:
                log.warning("the seconds before the fault are in %s", future.result())

    def write_file(self, label: str) -> None:
        """Hand the history to the recorder's thread."""
        self._files.append(self._recorder.write_fault_file(label))

    def finish(self) -> None:
        """Write a file that is still due, at the end of the daemon."""
        if self._file_due_ns:
            self.write_file(self._file_label)
            self._file_due_ns = 0


# Tells how each test of the wiring ended: a line in the journal, an event in the recording, a part of the status.
#
# Around the loop, beside the watch over faults, whose table has no room for what was measured.


wiring_log = logging.getLogger("servod.wiring")


class ProofWatch:
    """Looks whether another test has ended; `see` once per round."""

    def __init__(self, loop: LoopHandle, recorder: Recorder) -> None:
        self._loop, self._recorder = loop, recorder
        self._told = 0

    def see(self) -> None:
        """Tell of a test that ended since the last call."""
        count, proof = self._loop.proofs
        if proof is None or count == self._told:
            return
        self._told = count
        text = sentence(proof)
        wiring_log.log(logging.INFO if proof.passed else logging.ERROR, "%s", text)
        self._recorder.add_event("wiring", text, finding=Finding(int(proof.finding)).name)

    def status(self) -> WiringStatus:
        """How many tests there were since the start, and how the last one ended."""
        count, proof = self._loop.proofs
        return {"tests": count, "last": None if proof is None else document(proof)}
