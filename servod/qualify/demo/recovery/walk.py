"""`servoctl demo --diagnose`: an axis conceals an effect, its recordings tell which, the controller learns of it.

Beside the data path. Design for what is believed, track, record, diagnose, design anew, deploy, track again; every step
is the product's own.
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
from servod.common.errors import AnswerIsNo
from servod.common.files import write_bytes
from servod.formats.gains.design import Uncertainty
from servod.formats.gains.gain_set import GainSet
from servod.formats.model.axis_model import AxisModel, axis_model_yaml, load_axis_model
from servod.lab.commission.comparison import save_rows
from servod.lab.deploy.deployment import deploy
from servod.lab.deploy.judge import broken, skipped
from servod.lab.deploy.outcome import Deployment
from servod.lab.diagnose.effects import names
from servod.lab.diagnose.engine import diagnose
from servod.lab.diagnose.result import Diagnosis, DiagnosisVerdict
from servod.lab.recordings import load_recording
from servod.lab.recordings.recording import Rows, moving, rows_of
from servod.lab.report.diagnosis import MODEL, write_files
from servod.lab.synthesize.deployed import Wishes
from servod.lab.synthesize.gain_set import Options, synthesize
from servod.lab.synthesize.infeasible import Infeasible
from servod.lab.tracking.metrics import REST_S, Array, score
from servod.lab.verify.certify import verify
from servod.lab.verify.checks import LEAST_PLANTS
from servod.lab.verify.vertices import least_widths

#: Told what is done, and the share of the whole that is.
Tell = Callable[[str, float], None]

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
class Recovery:
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
        return list(broken(came, gains.certificate.promised, 2.0 * math.pi / gains.design.counts_per_turn))

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
    tell: Tell,
    seed: int = 1,
    effort: Effort = Effort(),
) -> Recovery:
    """Run the whole story; files stay in `out`. Raises AnswerIsNo when a step's answer is no."""
    paper = ReferenceMotion.paper(effort.paper_s)
    tell("design for what is believed", 0.02)
    write_bytes(out / "believed.yaml", axis_model_yaml(believed).encode())
    first = designed(believed, out / "believed.yaml", out / "gains_before.yaml", None, effort.plants)
    with socket_folder("servod-demo-") as folder:
        tell("the axis as it is believed to be", 0.2)
        with open_axis(believed, first.gains, _folder(folder, "believed"), seed) as axis:
            before = moved(axis, paper)
        with open_axis(true, first.gains, _folder(folder, "true"), seed) as axis:
            tell("the axis as it is", 0.25)
            concealed = moved(axis, paper)
            recordings = _recorded(axis, concealed, out, tell, effort)
            tell("diagnosis", 0.4)
            found, document = _diagnosed(believed, recordings, out / DIAGNOSIS)
            tell("design for what was found", 0.65)
            extended = _extended(believed, document, out)
            second = designed(load_axis_model(extended), extended, out / "gains_after.yaml", first.gains, effort.plants)
            done = _deployed(axis, second.gains, tell)
            tell("the axis under what was found", 0.95)
            after = moved(axis, paper)
    return Recovery(effect, before, concealed, after, found, document, first, second, done)


def moved(axis: AxisClient, motion: ReferenceMotion) -> Rows:
    """The cycles of a motion that begins at rest. Raises AnswerIsNo when the axis drops out."""
    axis.wait(REST_S)
    return moving(rows_of(axis.run(motion)))


def _deployed(axis: AxisClient, gains: GainSet, tell: Tell) -> Deployment:
    """Put the set on trial; again where it was turned down and the loop had skipped cycles, as deploy advises then."""
    for _ in range(_TRIALS):
        done = deploy(axis, gains, lambda what, share: tell(f"deploy: {what}", 0.85 + 0.08 * share))
        if done.proven or done.rows_after is None or not skipped(done.rows_after):
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
    options, said = Options(name=gains_file.stem, observer=False), ""
    for scale in SCALES:
        wishes = Wishes(cutoff_hz=cutoff, uncertainty=_narrowed(model, scale))
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


def _narrowed(model: AxisModel, scale: float) -> Uncertainty:
    """The usual uncertainty times `scale`, but nowhere narrower than a certificate allows."""
    scaled = Uncertainty().scaled(scale)
    least = {key: max(width, getattr(scaled, key)) for key, width in least_widths(model).items()}
    return scaled.model_copy(update=least)


def _recorded(axis: AxisClient, tracked: Rows, out: Path, tell: Tell, effort: Effort) -> list[Path]:
    """The axis's own recordings: a part of (19), and motions that show more."""
    runs = {"paper": tracked[time_s(tracked) < effort.diagnosed_s]}
    for index, (name, positions) in enumerate(motions(effort.motion_s).items()):
        tell(f"recording: {name}", 0.3 + 0.03 * index)
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
