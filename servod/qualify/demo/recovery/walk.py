"""`servoctl demo --diagnose`: an axis conceals an effect, its recordings tell which, the controller learns of it.

Beside the data path. Design for what is believed, track, record, diagnose, design again, deploy, track again; every
step is the product's own.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from servod.client.axis import AxisClient, ReferenceMotion
from servod.client.processes import socket_folder
from servod.common.errors import AnswerIsNo, BadInput
from servod.common.files import write_bytes
from servod.common.progress import OnProgress
from servod.formats.gains.design import Uncertainty
from servod.formats.gains.gain_set import GainSet
from servod.formats.model.axis_model import AxisModel, axis_model_yaml, load_axis_model
from servod.kernels.scoring import SETTLE_S
from servod.lab.commission.comparison import save_rows
from servod.lab.deploy.deployment import deploy
from servod.lab.deploy.judge import broken_promises, doubtful_timing
from servod.lab.deploy.outcome import Deployment
from servod.lab.diagnose.document import describe_certainty
from servod.lab.diagnose.effects import names
from servod.lab.diagnose.engine import diagnose
from servod.lab.diagnose.result import Diagnosis, DiagnosisVerdict
from servod.lab.recordings import load_recording
from servod.lab.recordings.recording import Rows, moving, rows_of
from servod.lab.report.diagnosis import MODEL, DiagnosisReport, write_files
from servod.lab.report.figure import Colour, Curve, Figure, PageTable, PlotAxis, PlotPanel, curve
from servod.lab.report.figures import mismatch
from servod.lab.report.figures.signature import signature_figure
from servod.lab.report.page import Origin, Verdict
from servod.lab.synthesize.deployed import Wishes
from servod.lab.synthesize.gain_set import DesignOptions, synthesize
from servod.lab.synthesize.infeasible import Infeasible
from servod.lab.synthesize.regions import narrowed
from servod.lab.tracking.metrics import REST_S, Array, score
from servod.lab.verify.certify import verify
from servod.lab.verify.checks import LEAST_PLANTS

#: Opens an enabled axis: joint, gain set, folder, seed of its noise.
OpenAxis = Callable[[AxisModel, GainSet, Path, int], AbstractContextManager[AxisClient]]

#: Shares of the usual uncertainty that a design is tried with: what recordings fitted is known better.
SCALES = (1.0, 0.5, 0.25)

#: Folder of the diagnosis within the demo's.
DIAGNOSIS = "diagnosis"

#: What the diagnosis may take, s: some times what it needs, for a machine that has other work.
TIME_LIMIT_S = 300.0

#: A trial in which the loop skipped cycles says nothing of the set; on a machine with other work there is one more.
_TRIALS = 3


@dataclass(frozen=True)
class Effort:
    """How long (19) is tracked, how much of it is diagnosed, how long each motion for the diagnosis is, s; and the
    plants of a certificate.
    """

    paper_s: float = 30.0
    diagnosed_s: float = 14.0
    motion_s: float = 12.0
    plants: int = LEAST_PLANTS


@dataclass(frozen=True)
class Designed:
    """A certified set, and the share of the usual uncertainty of a model that it is certified for."""

    gains: GainSet
    scale: float

    @property
    def promised_mrad(self) -> dict[str, float]:
        """What its certificate promised of the validation motion, mrad."""
        promised = self.gains.certificate.promised if self.gains.certificate else None
        values = promised.model_dump() if promised else {}
        return {k.replace("_rad", "_mrad"): 1e3 * v for k, v in values.items() if k.endswith("_rad")}


@dataclass(frozen=True)
class Retrofit:
    """What came of it; rows are the cycles on trajectory (19), figures RMS errors there in mrad."""

    effect: str
    before: Rows
    concealed: Rows
    after: Rows
    diagnosis: Diagnosis
    document: dict[str, Any]
    first: Designed
    second: Designed
    deployment: Deployment

    @property
    def rms_mrad(self) -> dict[str, float]:
        """RMS error on (19) without its first second: as believed, with the effect concealed, and after.

        "As believed" was measured, on an axis that is what the model says; no certificate speaks of (19).
        """
        runs = {"before": self.before, "concealed": self.concealed, "after": self.after}
        return {name: score(time_s(rows), error_mrad(rows)).rms_error_mrad for name, rows in runs.items()}

    def summary(self) -> dict[str, Any]:
        """The command's JSON document."""
        rms = self.rms_mrad
        findings = [{"effect": f["effect"], "confidence": f["confidence"]} for f in self.document["findings"]]
        return {
            "concealed": self.effect,
            "verdict": self.document["verdict"],
            "findings": findings,
            "rms_error_mrad": rms,
            "recovered_share": self.recovered_share,
            "deployment": self.deployment.document(),
            "promised_before": self.first.promised_mrad,
            "uncertainty_scale": {"before": self.first.scale, "after": self.second.scale},
            "broken_promises": self.broken_promises,
        }

    @property
    def broken_promises(self) -> list[str]:
        """What of the first certificate's promises for the validation motion did not come true, a sentence each."""
        gains, came = self.first.gains, self.deployment.before
        if came is None or gains.design is None or gains.certificate is None or gains.certificate.promised is None:
            return []
        return list(broken_promises(came, gains.certificate.promised, 2.0 * math.pi / gains.design.counts_per_turn))

    @property
    def recovered_share(self) -> float:
        """Share of the error that the effect cost which is gone again."""
        rms = self.rms_mrad
        return (rms["concealed"] - rms["after"]) / max(rms["concealed"] - rms["before"], 1e-12)


def within(scale: float) -> str:
    """How much of the model may be off under a certificate, in words."""
    if scale == 1.0:
        return "within the usual uncertainty of a model"
    return f"within {scale:g} of the usual uncertainty of a model (more of it got no certificate)"


def time_s(rows: Rows) -> Array:
    """Time since the motion began."""
    return np.asarray((rows["time_ns"] - rows["time_ns"][0]) * 1e-9)


def error_mrad(rows: Rows) -> Array:
    """Reference minus encoder position."""
    return np.asarray((rows["reference_rad"] - rows["position_rad"]) * 1e3)


def recover(
    believed: AxisModel,
    true: AxisModel,
    effect: str,
    open_axis: OpenAxis,
    out: Path,
    on_progress: OnProgress,
    seed: int = 1,
    effort: Effort = Effort(),
) -> Retrofit:
    """Run the whole story; files stay in `out`. Raises AnswerIsNo when a step's answer is no."""
    paper = ReferenceMotion.paper(effort.paper_s)
    on_progress("design for what is believed", 0.02)
    write_bytes(out / "believed.yaml", axis_model_yaml(believed).encode())
    first = designed(believed, out / "believed.yaml", out / "gains_before.yaml", None, effort.plants)
    with socket_folder("servod-demo-") as folder:
        on_progress("the axis as it is believed to be", 0.2)
        with open_axis(believed, first.gains, _folder(folder, "believed"), seed) as axis:
            before = moved(axis, paper)
        with open_axis(true, first.gains, _folder(folder, "true"), seed) as axis:
            on_progress("the axis as it is", 0.25)
            concealed = moved(axis, paper)
            recordings = _recorded(axis, concealed, out, on_progress, effort)
            on_progress("diagnosis", 0.4)
            found, document = _diagnosed(believed, recordings, out / DIAGNOSIS)
            on_progress("design for what was found", 0.65)
            extended = _extended(believed, document, out)
            second = designed(load_axis_model(extended), extended, out / "gains_after.yaml", first.gains, effort.plants)
            done = _deployed(axis, second.gains, on_progress)
            on_progress("the axis under what was found", 0.95)
            after = moved(axis, paper)
    return Retrofit(effect, before, concealed, after, found, document, first, second, done)


def moved(axis: AxisClient, motion: ReferenceMotion) -> Rows:
    """The cycles of a motion that begins at rest. Raises AnswerIsNo when the axis drops out."""
    axis.wait(REST_S)
    return moving(rows_of(axis.run(motion)))


def _deployed(axis: AxisClient, gains: GainSet, on_progress: OnProgress) -> Deployment:
    """Put the set on trial; again where it was turned down and the loop had skipped cycles, as deploy advises then."""
    for _ in range(_TRIALS):
        done = deploy(axis, gains, lambda what, share: on_progress(f"deploy: {what}", 0.85 + 0.08 * share))
        if done.proven or done.rows_after is None or not doubtful_timing(done.rows_after):
            break
    return done


def _folder(parent: str, name: str) -> Path:
    folder = Path(parent) / name
    folder.mkdir()
    return folder


def designed(
    model: AxisModel, model_file: Path, gains_file: Path, same_filter: GainSet | None, plants: int
) -> Designed:
    """The paper's law for `model` with a certificate, without a disturbance observer beside it, which would hide much.

    `same_filter` is a set whose velocity filter the axis has already. Raises AnswerIsNo.
    """
    cutoff = same_filter.design.velocity_cutoff_hz if same_filter and same_filter.design else None
    options, said = DesignOptions(name=gains_file.stem, observer=False), ""
    for scale in SCALES:
        wishes = Wishes(cutoff_hz=cutoff, uncertainty=narrowed(Uncertainty(), scale, model))
        found = synthesize(model, wishes, options, model_file)
        if isinstance(found, Infeasible):
            said = f"no feedback for {model_file.name}: {'; '.join(found.clashes)}"
            continue
        checked = verify(found, plants, where=str(gains_file), least_plants=plants)
        certified = checked.certified(found)
        write_bytes(gains_file, certified.to_yaml().encode())
        if checked.valid:
            return Designed(certified, scale)
        said = f"{gains_file}: not valid: {'; '.join(c.name for c in checked.checks if not c.passed)}"
    raise AnswerIsNo(said)


def _recorded(axis: AxisClient, tracked: Rows, out: Path, on_progress: OnProgress, effort: Effort) -> list[Path]:
    """The axis's own recordings: a part of (19), and motions that show more."""
    runs = {"paper": tracked[time_s(tracked) < effort.diagnosed_s]}
    for index, (name, positions) in enumerate(motions(effort.motion_s).items()):
        on_progress(f"recording: {name}", 0.3 + 0.03 * index)
        runs[name] = moved(axis, ReferenceMotion.table(positions.tolist()))
    paths = [out / "recordings" / f"{name}.mcap" for name in runs]
    for path, rows in zip(paths, runs.values(), strict=True):
        save_rows(path, rows)
    return paths


def _diagnosed(believed: AxisModel, recordings: list[Path], out: Path) -> tuple[Diagnosis, dict[str, Any]]:
    """The same code as `servoctl diagnose`. Raises AnswerIsNo when these data cannot tell."""
    found = diagnose(believed, [load_recording(path) for path in recordings], TIME_LIMIT_S)
    out.mkdir(parents=True, exist_ok=True)
    document = write_files(out, found, "believed.yaml")
    if found.verdict is DiagnosisVerdict.CANNOT_TELL:
        raise AnswerIsNo(document["summary"])
    return found, document


def _extended(believed: AxisModel, document: dict[str, Any], out: Path) -> Path:
    """File of the model to design for: what was found, with the delay as commissioning knows it.

    Tracking tells fractions of a cycle poorly, and feedback for a fraction too much or too little fails its proof or
    gives away stiffness. A delay that has a name stands.
    """
    model, path = load_axis_model(out / DIAGNOSIS / MODEL), out / "extended.yaml"
    late = names(lambda what: bool(what.lateness))
    if not late.intersection(finding["effect"] for finding in document["findings"]):
        model = model.model_copy(update={"delay_s": believed.delay_s})
    write_bytes(path, axis_model_yaml(model).encode())
    return path


def motions(duration_s: float, period_s: float = 0.001) -> dict[str, Array]:
    """Positions for a diagnosis, rad: a slow sine over a long way, a mix of frequencies, moves with rests between."""
    t = np.arange(round(duration_s / period_s)) * period_s
    fade = np.minimum(1.0, np.minimum(t, t[::-1]))
    slow = 0.5 * np.sin(2.0 * math.pi * 0.25 * t) * fade
    parts = ((0.12, 0.4, 0.0), (0.06, 1.1, 1.0), (0.025, 2.3, 2.0), (0.012, 4.1, 3.0))
    mixed = sum((a * np.sin(2.0 * math.pi * f * t + p) for a, f, p in parts), start=np.zeros_like(t)) * fade
    corners = np.arange(0.0, duration_s + 0.8, 0.8)
    moves = np.interp(t, corners, np.resize([0.0, 0.4, 0.4, -0.3, -0.25, -0.25, 0.5], len(corners))) * fade
    width = round(0.3 / period_s) | 1
    smooth = np.hanning(width + 2)[1:-1]
    moves = np.convolve(np.pad(moves, width // 2, mode="edge"), smooth / smooth.sum(), mode="valid")
    return {"slow_sine": slow, "multisine": mixed, "moves": moves}


# --- What can be concealed -------------------------------------------------------------------------------------------
# What a virtual axis can conceal: effects of a size that costs tracking, and the model that does not know them. Sizes
# go with the joint's dry friction, so that any joint conceals something that counts.


#: What stands under the effect's key in the axis model file, for a joint of some dry friction in N*m.
CONCEALED: dict[str, Callable[[float], Any]] = {
    "cogging": lambda dry: {"harmonics": [_sine(0.3 * dry, 22.0, 0.7), _sine(0.1 * dry, 44.0, 2.1)]},
    "gravity": lambda dry: {"amplitude": 1.3 * dry, "phase": 0.3},
    "asymmetry": lambda _dry: {"positive_dry": 1.3, "negative_dry": 0.7},
    "spring": lambda dry: {"stiffness": 7.0 * dry, "rest": 0.1},
    "torque_offset": lambda dry: 0.5 * dry,
}

#: What is concealed when nobody says what.
DEFAULT = "gravity"

#: Noise of the demo's joint, where the plant has none of its own.
NOISE = {"torque_rms": 0.0003, "torque_bandwidth_hz": 200.0, "encoder_rms": 2.0e-6}


def _sine(amplitude: float, periods_per_turn: float, phase: float) -> dict[str, float]:
    return {"amplitude": amplitude, "periods_per_turn": periods_per_turn, "phase": phase}


def believed_and_true(plant: AxisModel, effect: str) -> tuple[AxisModel, AxisModel]:
    """The axis without and with the effect. An effect that `plant` has is taken out of what is believed.

    Raises BadInput for an effect that a controller cannot be told of, and that the plant does not have.
    """
    document = plant.model_dump(mode="json", exclude_none=True, exclude_defaults=True)
    document.setdefault("noise", NOISE)
    if effect in document:
        without = {key: value for key, value in document.items() if key != effect}
        return AxisModel.model_validate(without), plant
    if effect not in CONCEALED:
        raise BadInput("--conceal", repr(effect), ", ".join(CONCEALED) + ", or an effect that --plant has")
    dry = getattr(plant.friction, "coulomb", 0.0) or 0.05
    return AxisModel.model_validate(document), AxisModel.model_validate(document | {effect: CONCEALED[effect](dry)})


# --- The page --------------------------------------------------------------------------------------------------------
# The page of `servoctl demo --diagnose`: what was believed, what came, what was found, and what that gave back. The
# last step of `walk`; the diagnosis has its own page beside it.


#: Share of the cost that must come back.
LEAST_RECOVERED = 0.8

#: Runs as people read them, with their colours.
RUNS = {
    "before": ("as believed", Colour.BLACK),
    "concealed": ("with the effect concealed", Colour.ORANGE),
    "after": ("after diagnosis and new design", Colour.BLUE),
}


def write_recovery_page(found: Retrofit, out: Path) -> Path:
    """Write `report.html` and pictures into `out`. Raises BadInput when that is not possible."""
    rms, back = found.rms_mrad, min(100.0 * found.recovered_share, 100.0)
    verdict = Verdict(
        f"{back:.0f} % of what the concealed effect cost is back: {rms['before']:.3f} mrad "
        f"RMS on trajectory (19) as believed, {rms['concealed']:.3f} with it, {rms['after']:.3f} once it is known.",
        found.recovered_share >= LEAST_RECOVERED,
    )
    files = {"believed model": out / "believed.yaml", "extended model": out / "extended.yaml"}
    files |= {"gains before": out / "gains_before.yaml", "gains after": out / "gains_after.yaml"}
    recorded = {"recordings": sorted((out / "recordings").glob("*.mcap"))}
    report = DiagnosisReport(
        out, "servod demo: an axis that conceals something", verdict, Origin({**files, **recorded})
    )
    page = report.page
    page.points(story(found))
    report.figure(_errors(found))
    _figures(report, found)
    page.heading("What the diagnosis found in the axis's own recordings")
    page.points([f["statement"] for f in found.document["findings"]])
    page.points([line for f in found.document["findings"] for line in describe_certainty(f)])
    evidence, units = found.diagnosis.evidence, found.diagnosis.units
    if evidence is not None:
        report.figure(mismatch.where(evidence.maps_before, units))
        terms = [(one, named.effect) for named in evidence.findings for one in named.signatures]
        for one, effect in sorted(terms, key=lambda term: term[0].number):
            report.figure(signature_figure(one, effect, units))
    page.sentence(f"All of it: {DIAGNOSIS}/report.html, {DIAGNOSIS}/diagnosis.json and {DIAGNOSIS}/model.yaml.")
    return report.write()


def story(found: Retrofit) -> list[str]:
    """What happened, a sentence for each step."""
    name = found.effect.replace("_", " ")
    named = ", ".join(f["effect"].replace("_", " ") for f in found.document["findings"]) or "nothing by name"
    stays = "was deployed" if found.deployment.proven else f"was rolled back ({'; '.join(found.deployment.reasons)})"
    return [
        f"A controller was designed and certified for what is believed of the axis, {within(found.first.scale)}.",
        f"The axis has {name} that nobody told the controller of: {_kept(found)}.",
        f"The axis's own recordings were diagnosed: {named}.",
        f"A controller designed and certified for the extended model, {within(found.second.scale)}, {stays}.",
    ]


def _kept(found: Retrofit) -> str:
    """Whether the axis did what the first certificate promised."""
    if found.broken_promises:
        return f"it tracks worse than the certificate promised ({'; '.join(found.broken_promises)})"
    times = found.rms_mrad["concealed"] / found.rms_mrad["before"]
    return (
        "of the validation motion it does what the certificate promised all the same, and the error on trajectory (19) "
        f"is {times:.2g} times as large"
    )


def _errors(found: Retrofit) -> Figure:
    """The three errors on trajectory (19), over each other."""
    runs = {"before": found.before, "concealed": found.concealed, "after": found.after}
    curves: list[Curve] = []
    for key in ("concealed", "before", "after"):
        label, colour = RUNS[key]
        late = time_s(runs[key]) >= SETTLE_S
        curves.append(curve(label, time_s(runs[key])[late], error_mrad(runs[key])[late], colour, width=1.1))
    panel = PlotPanel(PlotAxis("time in s"), PlotAxis("error in mrad"), tuple(curves))
    caption = "Reference minus encoder position on trajectory (19), without its first second."
    return Figure("recovery", "Tracking before, with and after", (panel,), 1, caption, 1.3)


def _figures(report: DiagnosisReport, found: Retrofit) -> None:
    """What certificates promised of the validation motion, and what came."""
    first, done = found.first.promised_mrad, found.deployment.document()
    after = done["after"] or {}
    rows = [
        (
            key.removesuffix("_mrad"), f"{first.get(key, 0.0):.4g}", f"{value:.4g}",
            f"{done['promised'][key]:.4g}", f"{after[key]:.4g}" if key in after else "none",
        )
        for key, value in done["before"].items()
        if key in done["promised"] and isinstance(value, float)
    ]  # fmt: skip
    title = "The validation motion, RMS error in mrad: what the certificates promised, and what came"
    header = ("part", "promised at first", "came", "promised again", "came then")
    report.page.table(PageTable(title, header, tuple(rows)))
