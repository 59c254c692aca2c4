"""Step 1: experiments on the axis become a model with intervals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from servod.formats.model.axis_model import axis_model_yaml
from servod.lab.commission.state import IDENTIFIED, MODEL, RECORDINGS, digest, write_json, write_text
from servod.lab.commission.walk import Walk
from servod.lab.identify.bounds import LONGEST_TRAVEL_RAD
from servod.lab.identify.result import document, model_of
from servod.lab.identify.walk import identify


@dataclass(frozen=True)
class Identify:
    """Leaves the recordings, the model file, and the document of `servoctl identify --json`."""

    name: str = "identify"
    title: str = "identify"

    def outputs(self, _walk: Walk) -> tuple[str, ...]:
        """Files in the walk's folder."""
        return (MODEL, IDENTIFIED)

    def inputs(self, walk: Walk) -> dict[str, Any]:
        """The axis, and what the experiments may do."""
        o = walk.options
        return {"axis": walk.axis.identity, "seed": o.seed, "travel": o.travel_rad, "speed": o.speed_rad_s}

    def run(self, walk: Walk) -> None:
        """A virtual axis begins again, so that the same model comes out, and a real one when it is asked to (--again).

        Otherwise a real one goes on where it was interrupted.
        """
        options, opened = walk.options, walk.axis
        if not opened.virtual:
            walk.questions.agree(_free_travel(walk))
        with opened.experiments() as axis, walk.progress(self.title) as on_progress:
            analysis = identify(
                axis,
                walk.path(RECORDINGS),
                on_progress,
                travel_rad=options.travel_rad,
                speed_rad_s=options.speed_rad_s,
                seed=options.seed,
                resume=not opened.virtual and self.name not in options.again,
                subject=digest(opened.identity),
            )
        write_json(walk.path(IDENTIFIED), document(analysis))
        write_text(walk.path(MODEL), axis_model_yaml(model_of(analysis)))


def _free_travel(walk: Walk) -> str:
    travel, limits = walk.options.travel_rad or LONGEST_TRAVEL_RAD, walk.axis.config.limits
    return (
        f"move {walk.axis.config.name} by itself, up to {travel:g} rad to each side of where it stands, within "
        f"{limits.position_min_rad:g} to {limits.position_max_rad:g} rad and {limits.torque_nm:g} N*m; is its way free?"
    )
