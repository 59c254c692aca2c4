"""Step 4: the certified set is tried on the axis, and stays when it proves itself."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from servod.common.errors import AnswerIsNo
from servod.formats.gains.gain_set import GainSet, load_gains, pd_set
from servod.formats.model.axis_model import load_axis_model
from servod.lab.commission.comparison import load_rows, save_rows
from servod.lab.commission.state import AFTER_ROWS, BEFORE, BEFORE_ROWS, DEPLOYMENT, GAINS, MODEL, STORE, write_json
from servod.lab.commission.state import read_walk_json as read_json
from servod.lab.commission.walk import Walk
from servod.lab.deploy.deployment import deploy, motion_notice
from servod.lab.deploy.outcome import Baseline, Deployment
from servod.lab.identify.bounds import STIFF, feedback


@dataclass(frozen=True)
class Deploy:
    """Leaves the figures before and after, and both runs.

    The run before the change is kept before anything changes. An axis under a daemon may have kept the set when the
    walk was interrupted: taken up, the set is then compared with that run, and not with itself.
    """

    name: str = "deploy"
    title: str = "deploy"

    def outputs(self, walk: Walk) -> tuple[str, ...]:
        """The document, and what is there of both runs: a set that ran already may have nothing before it."""
        return (DEPLOYMENT, *(name for name in (BEFORE_ROWS, AFTER_ROWS) if walk.path(name).exists()))

    def inputs(self, walk: Walk) -> dict[str, Any]:
        """The set, and the axis."""
        return {**walk.hashes(GAINS), "axis": walk.axis.identity, "seed": walk.options.seed}

    def run(self, walk: Walk) -> None:
        """Raises AnswerIsNo when the set did not prove itself; the document then says why."""
        gains = load_gains(walk.path(GAINS))
        if not walk.axis.virtual:
            name = walk.axis.config.name
            walk.questions.agree(
                f"try the certified set {gains.name} on {name}: {motion_notice(gains)}; is its way free?"
            )
        with (
            walk.axis.deployment(walk.path(STORE), gains, _present(walk)) as axis,
            walk.progress(self.title) as on_progress,
        ):
            done = deploy(axis, gains, on_progress, remembered(walk), lambda before: remember(walk, before))
        _keep(walk, done)
        if not done.proven:
            raise AnswerIsNo(f"deploy: {done.said}")
        walk.say(f"deploy: {done.said}")


def remember(walk: Walk, before: Baseline) -> None:
    """Put the run before the change on disk, with the hash of the set that it was made for."""
    walk.path(BEFORE).unlink(missing_ok=True)  # it is not of the rows that come
    save_rows(walk.path(BEFORE_ROWS), before.rows)
    write_json(walk.path(BEFORE), {"present": list(before.present), **walk.hashes(GAINS)})


def remembered(walk: Walk) -> Baseline | None:
    """The run before the change to this very set, where an earlier attempt at the step left one. Raises BadInput."""
    if not (walk.path(BEFORE).exists() and walk.path(BEFORE_ROWS).exists()):
        return None
    found = read_json(walk.path(BEFORE))
    if found[GAINS] != walk.hashes(GAINS)[GAINS]:
        return None
    name, version = found["present"]
    return Baseline((name, version), load_rows(walk.path(BEFORE_ROWS)))


def _keep(walk: Walk, done: Deployment) -> None:
    """The document, and no run beside it that is not of this trial; the one before is on disk already."""
    if done.ran_before is None:
        walk.path(BEFORE).unlink(missing_ok=True)
        walk.path(BEFORE_ROWS).unlink(missing_ok=True)
    if done.rows_after is None:
        walk.path(AFTER_ROWS).unlink(missing_ok=True)
    else:
        save_rows(walk.path(AFTER_ROWS), done.rows_after)
    write_json(walk.path(DEPLOYMENT), done.document())


def _present(walk: Walk) -> GainSet:
    """What a virtual axis runs before: the PD feedback that its identification ended with."""
    model = load_axis_model(walk.path(MODEL))
    return pd_set("identification", *feedback(walk.axis.config, model.inertia, model.acts_after_s, STIFF))
