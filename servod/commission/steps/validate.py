"""Step 6: the deployed law and its rivals on the axis itself, on trajectory (19) and on two steps."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from servod.commission.axis import DaemonWalkAxis, VirtualWalkAxis
from servod.commission.daemon_tracking import measure_on_daemon
from servod.commission.files import GAINS, RIVALS, RUNS, TRACKING, TUNING, write_json
from servod.commission.pooled import run_jobs
from servod.commission.runs import save_curves
from servod.commission.steps.rivals import CLASSES, compared, contenders, rival_file
from servod.commission.walk import Walk
from servod.errors import AnswerIsNo
from servod.gains import load_gains
from servod.tracking.stepped import measure
from servod.tune.plan import Feedback

#: The noise under which the laws are scored is not the one that they were tuned in.
SCORING_SEED = 1000
DEPLOYED = "local"


@dataclass(frozen=True)
class Validate:
    """Leaves the figures of every law, and the curves of its runs."""

    name: str = "validate"
    title: str = "compare on the axis"
    outputs: tuple[str, ...] = (TRACKING,)

    def inputs(self, walk: Walk) -> dict[str, Any]:
        """The sets that run, and the axis."""
        sets = [f"{RIVALS}/{rival_file(walk, *who).name}" for who in contenders()] if compared(walk) else []
        return {**walk.hashes(GAINS, TUNING, *sets), "axis": walk.axis.identity, "seed": walk.options.seed}

    def run(self, walk: Walk) -> None:
        """Every law meets the same axis with the same noise."""
        axis = walk.axis
        if isinstance(axis, VirtualWalkAxis):
            found = _on_virtual(walk, axis, self.title)
        elif isinstance(axis, DaemonWalkAxis):
            walk.questions.agree("track trajectory (19) and steps of 100 and 10 mrad with the deployed set (72 s)?")
            with walk.progress(self.title) as tell:
                tracking, missing = measure_on_daemon(axis.socket, axis.config, partial(tell, "deployed law"))
            found = {"tracking": {DEPLOYED: tracking.document()} if tracking else {}, "not_measured": missing}
            if tracking:
                save_curves(walk.path(RUNS) / f"free_{DEPLOYED}.npz", tracking.curves)
        write_json(walk.path(TRACKING), found)


def _on_virtual(walk: Walk, axis: VirtualWalkAxis, title: str) -> dict[str, Any]:
    """The deployed law among the free ones, and the class of equal feedback."""
    deployed = load_gains(walk.path(GAINS))
    assert deployed.design is not None  # a certified set has one
    runs = {(Feedback.FREE, DEPLOYED): walk.path(GAINS)}
    if compared(walk):
        runs |= {who: rival_file(walk, *who) for who in contenders()}
    seed, cutoff_hz = walk.options.seed + SCORING_SEED, deployed.design.velocity_cutoff_hz
    jobs = [
        (axis, file, cutoff_hz, seed, walk.path(RUNS) / f"{who[0].value}_{who[1]}.npz") for who, file in runs.items()
    ]
    names = [f"{name}, {feedback.value} feedback" for feedback, name in runs]
    with walk.progress(title) as tell:
        figures = dict(zip(runs, run_jobs(_measure, jobs, names, walk.options.processes, tell), strict=True))
    if "failed" in (proven := figures[Feedback.FREE, DEPLOYED]):
        raise AnswerIsNo(f"validate: {proven['failed']}")
    classes = {
        f"{feedback.value}_feedback": {
            name: figures[feedback, name] for name in (*CLASSES[feedback], DEPLOYED) if (feedback, name) in figures
        }
        for feedback in CLASSES
    }
    return {"tracking": classes["free_feedback"], **classes}


def _measure(axis: VirtualWalkAxis, gains: Path, cutoff_hz: float, seed: int, curves: Path) -> dict[str, Any]:
    """In a worker: one law over the whole CAN loop; of one that the axis drops out under only that is told."""
    with tempfile.TemporaryDirectory(prefix="servod-commission-") as folder:
        try:
            found = measure(lambda: axis.open_session(Path(folder), cutoff_hz, seed), load_gains(gains))
        except AnswerIsNo as error:
            return {"rms_error_mrad": None, "max_error_mrad": None, "steps": {}, "failed": str(error)}
    save_curves(curves, found.curves)
    return found.document()
