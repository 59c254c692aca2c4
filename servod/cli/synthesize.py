"""`servoctl synthesize`: from an axis model to a gain set with feedback for both regions and their proofs.

Works on files alone; needs the lab extra (cvxpy). The set comes out without a certificate: `servoctl verify` issues it.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from servod.cli.common import JsonOption, example, one_thread, print_json
from servod.errors import AnswerIsNo

if TYPE_CHECKING:
    from servod.gains import GainSet
    from servod.synthesize.deployed import Infeasible

EXAMPLE = "servoctl synthesize --model model.yaml --out gains.yaml"


def register(app: typer.Typer) -> None:
    """Add the verb to `app`."""
    app.command(name="synthesize", help=example("Compute a gain set for an axis model.", EXAMPLE))(synthesize)


def synthesize(
    model: Annotated[Path, typer.Option(help="Axis model (YAML).")],
    out: Annotated[Path, typer.Option(help="Gain set to write (YAML).")],
    name: Annotated[str, typer.Option(help="Name of the gain set.")] = "synthesized",
    accuracy: Annotated[float, typer.Option(min=0.001, max=0.5, help="Force tolerance between local sets.")] = 0.02,
    paper_nodes: Annotated[bool, typer.Option("--paper-nodes", help="The paper's nine local sets.")] = False,
    uncertainty: Annotated[float, typer.Option(min=0.0, max=10.0, help="Scale of all intervals.")] = 1.0,
    cutoff_hz: Annotated[float | None, typer.Option(min=10.0, max=2000.0, help="Velocity filter, Hz.")] = None,
    decay: Annotated[float, typer.Option(min=0.1, max=500.0, help="Least decay, 1/s.")] = 5.0,
    damping: Annotated[float, typer.Option(min=0.001, max=0.9, help="Least damping ratio.")] = 0.05,
    speed: Annotated[float, typer.Option(min=0.01, max=100.0, help="Highest speed of the map, rad/s.")] = 0.5,
    observer: Annotated[bool, typer.Option(help="Output disturbance observer.")] = True,
    as_json: JsonOption = False,
) -> None:
    """Synthesize a gain set for MODEL; exit code 1 when the demands cannot be met."""
    one_thread()
    from servod.axis_model import load_axis_model
    from servod.gain_store import write_atomically
    from servod.synthesize.deployed import Infeasible, Wishes
    from servod.synthesize.gain_set import Options, synthesize
    from servod.synthesize.intervals import uncertainty_of

    axis = load_axis_model(model)
    wishes = Wishes(
        uncertainty=uncertainty_of(axis).scaled(uncertainty),
        cutoff_hz=cutoff_hz,
        least_decay_per_s=decay,
        least_damping=damping,
        speed_max=speed,
    )
    result = synthesize(axis, wishes, Options(name, accuracy, paper_nodes, observer=observer), model)
    if isinstance(result, Infeasible):
        refuse(result, as_json)
        return
    write_atomically(out, result.to_yaml())
    document = summary(result, out)
    if as_json:
        print_json(document)
    else:
        print_summary(document)


def refuse(result: Infeasible, as_json: bool) -> None:
    """Say why there is no design and what would help. Raises AnswerIsNo."""
    if as_json:
        relaxations = [{"wish": r.wish, "asked": r.asked, "enough": r.enough} for r in result.relaxations]
        print_json(
            {"feasible": False, "regions": result.regions, "clashes": result.clashes, "relaxations": relaxations}
        )
    else:
        for line in result.clashes:
            print(f"clash: {line}")
        for relaxation in result.relaxations:
            print(f"would do by itself: {relaxation}")
    raise AnswerIsNo(f"no feedback for region {' and '.join(result.regions) or 'low and high together'} found")


def summary(gains: GainSet, out: Path) -> dict[str, Any]:
    """The command's JSON document."""
    assert gains.design is not None
    parameters = gains.parameters.model_dump(mode="json")
    return {
        "feasible": True,
        "out": str(out),
        "name": gains.name,
        "mode": gains.design.mode.value,
        "regions": parameters["regions"],
        "input_scale_nm": parameters["input_scale_nm"],
        "local_sets": len(parameters["friction"]["sets"]),
        "disturbance_observer": parameters["disturbance_observer"],
        "velocity_cutoff_hz": gains.design.velocity_cutoff_hz,
        "uncertainty": gains.design.uncertainty.model_dump(),
        "certified": False,
    }


def print_summary(document: dict[str, Any]) -> None:
    """Print the summary for people."""
    scale = document["input_scale_nm"]
    for region in ("low", "high"):
        gains = document["regions"][region]
        position, speed = scale * gains["k_x_per_rad"], scale * gains["k_v_s_per_rad"]
        print(f"region {region}: {position:.4g} N*m/rad, {speed:.4g} N*m*s/rad")
    observer = document["disturbance_observer"]
    print(f"{document['local_sets']} local sets; observer {observer['bandwidth_rad_s'] if observer else 0:g} rad/s")
    print(f"set encoder.velocity_cutoff_hz to {document['velocity_cutoff_hz']:g}")
    print(f"written to {document['out']}; `servoctl verify {document['out']}` certifies it")
