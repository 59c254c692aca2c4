"""Step 4: the certified set is tried on the axis, and stays when it proves itself."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from servod.axis_model import load_axis_model
from servod.commission.files import DEPLOYMENT, GAINS, MODEL, RUNS, STORE, write_json
from servod.commission.runs import save_rows
from servod.commission.walk import Walk
from servod.deploy.deployment import Deployment, announced, deploy
from servod.deploy.virtual import pd_set
from servod.errors import AnswerIsNo
from servod.gains import GainSet, load_gains
from servod.identify.feedback import STIFF, feedback

#: Recordings of the motion under the set of before and under the new one.
_MOTIONS = ("deploy_before", "deploy_after")


@dataclass(frozen=True)
class Deploy:
    """Leaves the figures before and after, and both runs."""

    name: str = "deploy"
    title: str = "deploy"

    def outputs(self, _walk: Walk) -> tuple[str, ...]:
        """Files in the walk's folder."""
        return (DEPLOYMENT, *(f"{RUNS}/{name}.mcap" for name in _MOTIONS))

    def inputs(self, walk: Walk) -> dict[str, Any]:
        """The set, and the axis."""
        return {**walk.hashes(GAINS), "axis": walk.axis.identity, "seed": walk.options.seed}

    def run(self, walk: Walk) -> None:
        """Raises AnswerIsNo when the set was rolled back; the document then says why."""
        gains = load_gains(walk.path(GAINS))
        if not walk.axis.virtual:
            name = walk.axis.config.name
            walk.questions.agree(f"try the certified set {gains.name} on {name}: {announced(gains)}; is its way free?")
        with (
            walk.axis.deployment(walk.path(STORE), gains, _present(walk)) as link,
            walk.progress(self.title) as tell,
        ):
            done = deploy(link, gains, tell)
        self._keep(walk, done)
        if not done.stays:
            raise AnswerIsNo(f"deploy: rolled back: {'; '.join(done.reasons)}")

    def _keep(self, walk: Walk, done: Deployment) -> None:
        for name, rows in zip(_MOTIONS, (done.rows_before, done.rows_after), strict=True):
            if rows is not None:
                save_rows(walk.path(RUNS) / f"{name}.mcap", rows)
        write_json(walk.path(DEPLOYMENT), done.document())


def _present(walk: Walk) -> GainSet:
    """What a virtual axis runs before: the PD feedback that its identification ended with."""
    model = load_axis_model(walk.path(MODEL))
    return pd_set("identification", *feedback(walk.axis.config, model.inertia, model.total_delay_s, STIFF))
