"""Step 3: the set is judged from itself alone, and gets its certificate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from servod.common.errors import AnswerIsNo
from servod.common.sources import VERIFIES, source_sha256
from servod.formats.gains.gain_set import load_gains
from servod.lab.commission.state import CERTIFICATE, DESIGN, GAINS, write_json, write_text
from servod.lab.commission.walk import Walk
from servod.lab.verify.certify import SEED, verify


@dataclass(frozen=True)
class Verify:
    """Leaves the certified gain set, and the document of `servoctl verify --json`."""

    name: str = "verify"
    title: str = "verify"

    def outputs(self, _walk: Walk) -> tuple[str, ...]:
        """Files in the walk's folder."""
        return (GAINS, CERTIFICATE)

    def inputs(self, walk: Walk) -> dict[str, Any]:
        """The set, how thoroughly it is judged, and by which sources."""
        return {**walk.hashes(DESIGN), "plants": walk.options.plants, "seed": SEED, "tool": source_sha256(VERIFIES)}

    def run(self, walk: Walk) -> None:
        """Raises AnswerIsNo when the set is not valid; then the document stands alone, without a set to deploy."""
        gains = load_gains(walk.path(DESIGN))
        with walk.progress(self.title) as tell:
            tell(f"{walk.options.plants} plants", 0.1)
            options, where = walk.options, str(walk.path(DESIGN))
            result = verify(gains, options.plants, SEED, options.processes, where, least_plants=options.least_plants)
        write_json(walk.path(CERTIFICATE), result.document())
        if not result.valid:
            failed = [check.name for check in result.checks if not check.passed]
            raise AnswerIsNo(f"verify: not valid: {'; '.join(failed)}")
        write_text(walk.path(GAINS), result.certified(gains).to_yaml())
