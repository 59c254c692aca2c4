"""`servoctl synthesize`: from an axis model to a gain set with feedback for both regions and their proofs.

Works on files alone; needs the lab extra (cvxpy). The set comes out without a certificate: `servoctl verify` issues it.
"""

from __future__ import annotations

from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from servod.cli.common import JsonOption, example, need_file, one_thread, print_json, suggest
from servod.common.errors import AnswerIsNo, BadInput

if TYPE_CHECKING:
    from servod.formats.gains.gain_set import GainSet
    from servod.formats.model.axis_model import AxisModel
    from servod.lab.synthesize.deployed import Wishes
    from servod.lab.synthesize.gain_set import DesignOptions
    from servod.lab.synthesize.infeasible import Infeasible

# --- Options ---------------------------------------------------------------------------------------------------------
# Options of `servoctl synthesize`: every one with its range and a line of help; a default of None is the mode's own.
# Imports typer alone, as all verbs do.


class SynthesisMode(StrEnum):
    """The programme that is solved."""

    DEPLOYED = "deployed"
    REFERENCE = "reference"


class Weights(StrEnum):
    """Shapes of the weighting functions."""

    LINEAR = "linear"
    COSINE = "cosine"
    GAUSSIAN = "gaussian"


class Velocity(StrEnum):
    """Whose velocity drives the friction state."""

    CORRECTED_REFERENCE = "corrected_reference"
    REFERENCE = "reference"
    MEASURED = "measured"


Model = Annotated[Path, typer.Option(help="Axis model (YAML).")]
Out = Annotated[Path, typer.Option(help="Gain set to write (YAML).")]
Name = Annotated[str, typer.Option(help="Name of the gain set.")]
ModeOption = Annotated[
    SynthesisMode, typer.Option(help="Sampled, with delay and filter; or the paper's own programme.")
]
ScalarOutput = Annotated[bool, typer.Option("--scalar-output", help="Reference mode: the literal alpha*x + beta*u*.")]
CrossCheck = Annotated[bool, typer.Option("--cross-check", help="Solve again with SCS, and compare; half a minute.")]

Alpha = Annotated[float | None, typer.Option(min=1e-3, max=1e3, help="Weight alpha of the position error.")]
Beta = Annotated[float | None, typer.Option(min=1e-4, max=1e2, help="Weight beta of the torque.")]
Decay = Annotated[float | None, typer.Option(min=0.1, max=500.0, help="Least decay, 1/s.")]
ZetaMin = Annotated[
    float | None, typer.Option("--zeta-min", "--damping", min=0.001, max=0.85, help="Least damping ratio.")
]
Uncertainty = Annotated[
    float, typer.Option(min=0.0, max=10.0, help="Scale of all intervals; none gets narrower than may be certified.")
]
Delay = Annotated[float | None, typer.Option(min=0.0, max=0.02, help="Command to torque, s, instead of the model's.")]
Period = Annotated[int, typer.Option(min=250, max=10_000, help="Cycle, microseconds.")]
Cutoff = Annotated[float | None, typer.Option(min=10.0, max=2000.0, help="Velocity filter, Hz, instead of the best.")]
Counts = Annotated[int, typer.Option(min=0, max=2**40, help="Encoder counts per turn; 0 is no steps.")]

Speed = Annotated[float, typer.Option(min=0.01, max=100.0, help="Highest speed of the map, rad/s.")]
OverlapFrom = Annotated[float, typer.Option(min=1e-5, max=10.0, help="Omega_H begins at this speed, rad/s.")]
OverlapTo = Annotated[float, typer.Option(min=1e-5, max=10.0, help="Omega_L ends at this speed, rad/s.")]
Accuracy = Annotated[float, typer.Option(min=0.001, max=0.5, help="Force tolerance between local sets, a share.")]
PaperNodes = Annotated[bool, typer.Option("--paper-nodes", help="The paper's nine local sets.")]
WeightsOption = Annotated[Weights, typer.Option(help="Shape of the weighting functions.")]
VelocityOption = Annotated[
    Velocity, typer.Option(help="Whose velocity drives the friction state; corrected falls back where it swings.")
]
Observer = Annotated[bool, typer.Option(help="Output disturbance observer.")]
PositionTorque = Annotated[bool, typer.Option(help="Feed known torques over position forward.")]
Leak = Annotated[float, typer.Option(min=0.0, max=100.0, help="Least decay of the friction state, 1/s.")]
GainL = Annotated[float | None, typer.Option("--l", min=-1.0, max=1.0, help="l of all local sets; else designed.")]


EXAMPLES = (
    "servoctl synthesize --model model.yaml --out gains.yaml",
    "servoctl synthesize --model model.yaml --out paper.yaml --mode reference --cross-check",
)


def register(app: typer.Typer) -> None:
    """Add the verb to `app`."""
    app.command(name="synthesize", help=example("Compute a gain set for an axis model.", *EXAMPLES))(synthesize)


def synthesize(
    model: Model,
    out: Out,
    name: Name = "synthesized",
    mode: ModeOption = SynthesisMode.DEPLOYED,
    scalar_output: ScalarOutput = False,
    cross_check: CrossCheck = False,
    alpha: Alpha = None,
    beta: Beta = None,
    decay: Decay = None,
    zeta_min: ZetaMin = None,
    uncertainty: Uncertainty = 1.0,
    delay_s: Delay = None,
    period_us: Period = 1000,
    cutoff_hz: Cutoff = None,
    encoder_counts: Counts = 2**20,
    speed: Speed = 0.5,
    overlap_from: OverlapFrom = 0.005,
    overlap_to: OverlapTo = 0.02,
    accuracy: Accuracy = 0.02,
    paper_nodes: PaperNodes = False,
    weights: WeightsOption = Weights.LINEAR,
    velocity: VelocityOption = Velocity.CORRECTED_REFERENCE,
    observer: Observer = True,
    position_torque: PositionTorque = True,
    leak: Leak = 2.0,
    gain_l: GainL = None,
    as_json: JsonOption = False,
) -> None:
    """Synthesize a gain set for MODEL; exit code 1 when the demands cannot be met."""
    one_thread()
    from servod.formats.model.axis_model import load_axis_model

    need_order(overlap_from, overlap_to, speed)
    need_file("--out", out)
    axis = delayed(load_axis_model(model), delay_s)
    overlap = overlap_from, overlap_to
    wishes = wishes_of(axis, uncertainty, period_us, cutoff_hz, encoder_counts, speed, overlap)
    options = options_of(
        name, accuracy, paper_nodes, weights, velocity, observer, position_torque, leak_per_s=leak, gain=gain_l
    )
    asked = given(position_weight=alpha, torque_weight=beta, least_decay_per_s=decay, least_damping=zeta_min)
    finish(solved(mode, axis, wishes, options, asked, scalar_output, model), out, cross_check, as_json)


def wishes_of(
    axis: AxisModel,
    uncertainty: float,
    period_us: int,
    cutoff_hz: float | None,
    counts: int,
    speed: float,
    overlap: tuple[float, float],
) -> Wishes:
    """What is asked of the loop, with the intervals that were identified."""
    from servod.lab.synthesize.deployed import Wishes
    from servod.lab.synthesize.regions import narrowed, uncertainty_of

    known = uncertainty_of(axis)
    return Wishes(
        uncertainty=narrowed(known, uncertainty, axis) if uncertainty < 1.0 else known.scaled(uncertainty),
        period_s=1e-6 * period_us,
        cutoff_hz=cutoff_hz,
        counts_per_turn=float(counts),
        speed_max=speed,
        overlap=overlap,
    )


def options_of(
    name: str,
    accuracy: float,
    paper_nodes: bool,
    weights: Weights,
    velocity: Velocity,
    observer: bool,
    position_torque: bool,
    leak_per_s: float,
    gain: float | None,
) -> DesignOptions:
    """What is asked of the law."""
    from servod.formats.gains.parameters import VelocitySource, WeightShape
    from servod.lab.synthesize.gain_set import DesignOptions

    return DesignOptions(
        name,
        accuracy,
        paper_nodes,
        velocity=VelocitySource(velocity),
        observer=observer,
        gain=gain,
        leak_per_s=leak_per_s,
        weights=WeightShape(weights),
        position_feedforward=position_torque,
    )


def finish(result: GainSet | Infeasible, out: Path, cross_check: bool, as_json: bool) -> None:
    """Write and print the set, or say why there is none. Raises AnswerIsNo."""
    from servod.common.files import write_file
    from servod.lab.synthesize.infeasible import Infeasible

    if isinstance(result, Infeasible):
        refuse(result, as_json)
        return
    if cross_check:
        from servod.lab.synthesize.crosscheck import cross_checked

        result = cross_checked(result)
    write_file(out, result.to_yaml())
    suggest("verify", str(out), why="certifies it, or says why not")
    document = summary(result, out)
    if as_json:
        print_json(document)
    else:
        print_summary(document)


def need_order(overlap_from: float, overlap_to: float, speed: float) -> None:
    """The regions overlap, and Omega_H reaches beyond the overlap. Raises BadInput."""
    if overlap_from >= overlap_to:
        raise BadInput("--overlap-from", f"{overlap_from:g}", f"less than --overlap-to, {overlap_to:g}")
    if overlap_to >= speed:
        raise BadInput("--overlap-to", f"{overlap_to:g}", f"less than --speed, {speed:g}")


def delayed(model: AxisModel, delay_s: float | None) -> AxisModel:
    """`model` with another delay in total; the same when none is given."""
    return model if delay_s is None else model.model_copy(update={"delay_s": delay_s, "delay": None})


def given(**values: float | None) -> dict[str, Any]:
    """The wishes that were asked for; the others are the mode's own."""
    return {key: value for key, value in values.items() if value is not None}


def solved(
    mode: SynthesisMode,
    axis: AxisModel,
    wishes: Wishes,
    options: DesignOptions,
    asked: dict[str, Any],
    scalar_output: bool,
    path: Path,
) -> GainSet | Infeasible:
    """The set of the mode that was chosen, or why there is none."""
    from servod.lab.synthesize.gain_set import synthesize

    if mode is SynthesisMode.DEPLOYED:
        if scalar_output:
            raise BadInput("--scalar-output", "the deployed mode", "--mode reference")
        return synthesize(axis, replace(wishes, **asked), options, path)
    from servod.formats.gains.design import ReferenceOutput
    from servod.lab.synthesize.lmi_reference import ReferenceWishes
    from servod.lab.synthesize.reference import reference_set

    output = ReferenceOutput.SCALAR if scalar_output else ReferenceOutput.VECTOR
    return reference_set(axis, wishes, options, ReferenceWishes(output=output, **asked), path)


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
    provenance = gains.provenance.model_dump(mode="json")
    return {
        "feasible": True,
        "out": str(out),
        "name": gains.name,
        "mode": gains.design.mode.value,
        "regions": parameters["regions"],
        "input_scale_nm": parameters["input_scale_nm"],
        "local_sets": len(parameters["friction"]["sets"]),
        "equation_8": cited_mismatch(gains),
        "gains_l": [s["gain"] for s in parameters["friction"]["sets"]],
        "disturbance_observer": parameters["disturbance_observer"],
        "position_feedforward": parameters["position_feedforward"],
        "velocity_cutoff_hz": gains.design.velocity_cutoff_hz,
        "uncertainty": gains.design.uncertainty.model_dump(),
        "cross_checks": provenance["cross_checks"],
        "hashes": {key: provenance[key] for key in ("model_sha256", "data_sha256", "tool_sha256")},
        "certified": False,
    }


def cited_mismatch(gains: GainSet) -> dict[str, float] | None:
    """What (8) of the paper says of neighbouring sets: cited, not used, for to the letter it wants equal forces."""
    from servod.formats.gains.parameters import LocalParameters
    from servod.lab.synthesize.local_sets import FINITE_TIME_S, largest_mismatch

    law = gains.parameters
    found = largest_mismatch(law.friction) if isinstance(law, LocalParameters) else None
    return found and {"time_s": FINITE_TIME_S, **found._asdict()}


def print_summary(document: dict[str, Any]) -> None:
    """Print the summary for people."""
    scale = document["input_scale_nm"]
    for region in ("low", "high"):
        gains = document["regions"][region]
        position, speed = scale * gains["k_x_per_rad"], scale * gains["k_v_s_per_rad"]
        print(f"region {region}: {position:.4g} N*m/rad, {speed:.4g} N*m*s/rad")
    observer = document["disturbance_observer"]
    print(f"{document['local_sets']} local sets; observer {observer['bandwidth_rad_s'] if observer else 0:g} rad/s")
    apart = document["equation_8"]
    if apart:
        between = f"{apart['from_rad_s']:.3g} and {apart['to_rad_s']:.3g} rad/s"
        print(f"(8) after {apart['time_s']:g} s: neighbours differ by {100 * apart['share']:.2g} % at most, {between}")
    if any(document["gains_l"]):
        print(f"l from {min(document['gains_l']):.3g} to {max(document['gains_l']):.3g}")
    print_known(document["position_feedforward"])
    for check in document["cross_checks"] or []:
        print_cross_check(check)
    print(f"set encoder.velocity_cutoff_hz to {document['velocity_cutoff_hz']:g}")
    print(f"written to {document['out']}; `servoctl verify {document['out']}` certifies it")


def print_known(known: dict[str, Any] | None) -> None:
    """One line on what is fed forward over position."""
    if known is None:
        return
    waves = ", ".join(f"{1e3 * w['amplitude_nm']:.3g} mN*m at {w['waves_per_turn']:g} a turn" for w in known["waves"])
    spring = f"spring {known['spring_nm_per_rad']:g} N*m/rad" if known["spring_nm_per_rad"] else ""
    offset = f"constant {known['offset_nm']:g} N*m" if known["offset_nm"] else ""
    print(f"fed forward over position: {'; '.join(part for part in (waves, spring, offset) if part)}")


def print_cross_check(check: dict[str, Any]) -> None:
    """One line on what the second solver says of a region."""
    bounds = [f"{b:.4g}" if b is not None else "nothing" for b in (check["h2_bound"], check["other_h2_bound"])]
    verdict = "agrees" if check["agrees"] else "DISAGREES"
    limit = f"tolerance {100 * check['tolerance']:g} %"
    print(f"region {check['region']}: {check['solver']} {verdict}: H2 bound {bounds[1]} against {bounds[0]} ({limit})")
