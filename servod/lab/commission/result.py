"""The one document of a commissioning: what was identified, certified, deployed and measured, and how long it took.

Above the steps' files; `servoctl commission --json` prints it.
"""

from __future__ import annotations

from typing import Any

from servod.formats.gains.gain_set import load_gains
from servod.lab.commission.files import (
    CERTIFICATE,
    DEPLOYMENT,
    GAINS,
    IDENTIFIED,
    INFEASIBLE,
    MODEL,
    PICTURES,
    RELAXED,
    REPORT,
    RESULT,
    TRACKING,
    TUNING,
    read_json,
    write_json,
)
from servod.lab.commission.state import State
from servod.lab.commission.walk import StepFailed, Walk


def failure(walk: Walk, failed: StepFailed) -> dict[str, Any]:
    """The document of a walk that a step ended with a no: which one and why, and its own document where it has one."""
    own = {
        "synthesize": ("infeasible", INFEASIBLE),
        "verify": ("certificate", CERTIFICATE),
        "deploy": ("deployment", DEPLOYMENT),
    }
    key, name = own.get(failed.step, ("", ""))
    document: dict[str, Any] = {
        "axis": walk.axis.config.name,
        "failed": {"step": failed.step, "message": str(failed)},
    }
    if name and walk.path(name).exists():
        document[key] = read_json(walk.path(name))
    return document


def result(walk: Walk, state: State) -> dict[str, Any]:
    """Put the document together from the files of a walk that is complete, and keep it in the folder."""
    gains = load_gains(walk.path(GAINS))
    assert gains.design is not None  # a certified set has one
    document = {
        "axis": walk.axis.config.name,
        **read_json(walk.path(IDENTIFIED)),
        "relaxed": read_json(walk.path(RELAXED)),
        "velocity_cutoff_hz": gains.design.velocity_cutoff_hz,
        "certificate": read_json(walk.path(CERTIFICATE)),
        "deployment": read_json(walk.path(DEPLOYMENT)),
        "tuning": read_json(walk.path(TUNING)),
        **read_json(walk.path(TRACKING)),
        "seconds": state.seconds | {"total": round(sum(state.seconds.values()), 3)},
        "files": {
            "model": str(walk.path(MODEL)),
            "gains": str(walk.path(GAINS)),
            "report": str(walk.path(REPORT)),
            "pictures": str(walk.path(PICTURES)),
        },
    }
    write_json(walk.path(RESULT), document)
    return document
