"""Tells how each test of the wiring ended: a line in the journal, an event in the recording, a part of the status.

Around the loop, beside the watch over faults, whose table has no room for what was measured.
"""

from __future__ import annotations

import logging

from servod.runtime.daemon.recorder import Recorder
from servod.runtime.daemon.status import WiringStatus
from servod.runtime.loop.handle import LoopHandle
from servod.runtime.loop.wiring.findings import Finding, document, sentence

log = logging.getLogger("servod.wiring")


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
        log.log(logging.INFO if proof.passed else logging.ERROR, "%s", text)
        self._recorder.add_event("wiring", text, finding=Finding(int(proof.finding)).name)

    def status(self) -> WiringStatus:
        """How many tests there were since the start, and how the last one ended."""
        count, proof = self._loop.proofs
        return {"tests": count, "last": None if proof is None else document(proof)}
