"""The page of a commissioning and its pictures: from the files in its folder alone, so that it can be made at any time.

Stands on the figures of servod.lab.report. The last step of the walk makes it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from servod import __version__
from servod.client.open import VirtualWalkAxis
from servod.common.progress import OnProgress
from servod.formats.gains.gain_set import CertificateCheck, GainSet, load_gains
from servod.formats.model.axis_model import AxisModel, load_axis_model
from servod.kernels.laws import LABELS
from servod.lab.commission.comparison import DEPLOYED, load_curves, load_rows, run_files
from servod.lab.commission.state import (
    AFTER_ROWS,
    BEFORE_ROWS,
    CERTIFICATE,
    DEPLOYMENT,
    DESIGN,
    GAINS,
    IDENTIFIED,
    INFEASIBLE,
    MODEL,
    PICTURES,
    RECORDINGS,
    REFUSED,
    RELAXED,
    REPORT,
    RESULT,
    RUNS,
    TRACKING,
    TUNING,
    State,
    write_json,
)
from servod.lab.commission.state import read_walk_json as read_json
from servod.lab.commission.walk import StepFailed, Walk
from servod.lab.identify import store
from servod.lab.identify.analysis import analyse
from servod.lab.report.figure import Figure, PageTable
from servod.lab.report.figures import friction, loop, motion, sets
from servod.lab.report.figures.loop import PASSED
from servod.lab.report.figures.motion import PlottedMotion
from servod.lab.report.page import Origin, Page, Verdict
from servod.lab.report.pictures import write_pictures
from servod.lab.tracking.metrics import STEPS_MRAD, Curves, curve_key
from servod.lab.verify.margins import describe_margins

Part = Figure | PageTable | str
#: Laws as people read them.
NAMES = {**LABELS, DEPLOYED: "Deployed"}
#: Classes of the comparison as people read them, in the order of the page.
CLASSES = {
    "free_feedback": "Every law with feedback of its own",
    "equal_feedback": "Every law with the same feedback",
}


def write_report(walk: Walk, on_progress: OnProgress) -> None:
    """Write report.html, and every figure as PNG and SVG. Raises BadInput."""
    page = Page(f"Commissioning of {walk.axis.config.name}", Verdict(verdict(walk), True), _origin(walk))
    _summary(page, walk)
    gains, model = load_gains(walk.path(GAINS)), load_axis_model(walk.path(MODEL))
    shown = sections(walk, gains, model)
    for index, (title, parts) in enumerate(shown.items()):
        on_progress(title.lower(), index / len(shown))
        page.heading(title)
        for part in parts():
            _add(page, walk, part)
    page.write(walk.path(REPORT))


def write_refusal(walk: Walk, failed: StepFailed) -> Path | None:
    """Write refused.html of a walk that a step ended with a no: which one and why, what its checks found, and what the
    steps before had made. None where nothing of it is on disk yet. Raises BadInput.
    """
    parts = dict(_refused(walk, failed.step))
    if not parts:
        return None
    upto = max((k for k, (step, _, _) in enumerate(_MADE) if step == failed.step), default=len(_MADE))
    made = {what: walk.path(name) for _, what, name in _MADE[: upto + 1]}
    origin = Origin(made, walk.axis.config, walk.axis.nodes(), _facts(walk) | {"step": failed.step})
    page = Page(
        f"Commissioning of {walk.axis.config.name}", Verdict(str(failed).removesuffix(".") + ".", False), origin
    )
    page.sentence("Nothing of this runs on the axis: what ran before the commissioning still does.")
    for title, shown in parts.items():
        page.heading(title)
        for part in shown:
            if isinstance(part, Figure):
                page.figure(part)
            else:
                _add(page, walk, part)
    page.write(walk.path(REFUSED))
    return walk.path(REFUSED)


#: What a page of a refused walk is made from: the step that leaves it, what it is, and its file.
_MADE = (
    ("identify", "model", MODEL),
    ("synthesize", "design", DESIGN),
    ("verify", "verdict of the checks", CERTIFICATE),
    ("deploy", "gain set", GAINS),
    ("deploy", "deployment", DEPLOYMENT),
)


def _refused(walk: Walk, step: str) -> Iterator[tuple[str, Iterator[Part]]]:
    """The parts of such a page, what was refused first; files of later steps are of an earlier walk."""
    if step == "deploy" and walk.path(DEPLOYMENT).exists():
        yield "Deployment", _trial(walk)
    if step == "verify" and walk.path(CERTIFICATE).exists():
        yield "What the checks found", loop.judged_tables(SimpleNamespace(**_judged(walk)))
    if step == "synthesize" and walk.path(INFEASIBLE).exists():
        yield "What clashes", iter(read_json(walk.path(INFEASIBLE))["clashes"])
    if step != "identify" and walk.path(IDENTIFIED).exists():
        model = load_axis_model(walk.path(MODEL))
        yield "The axis as identified", _identified(walk, model)
        tried = walk.path(DESIGN if step == "verify" else GAINS)
        if step != "synthesize" and tried.exists():
            yield "The law and its design", _design(load_gains(tried), model)


def _judged(walk: Walk) -> dict[str, Any]:
    """The document of the checks with its checks as such."""
    found: dict[str, Any] = read_json(walk.path(CERTIFICATE))
    return found | {"checks": [CertificateCheck.model_validate(check) for check in found["checks"]]}


def _trial(walk: Walk) -> Iterator[Part]:
    """What a deployment that did not prove itself measured."""
    found = read_json(walk.path(DEPLOYMENT))
    columns = [run for run in ("before", "after", "promised") if found.get(run)]
    names = list(dict.fromkeys(name for run in columns for name in found[run]))
    rows = [
        (name.removesuffix("_mrad"), *(f"{found[run][name]:.4g}" if name in found[run] else "-" for run in columns))
        for name in names
    ]
    yield PageTable("Validation motion, mrad", ("figure", *columns), tuple(rows))


def _facts(walk: Walk) -> dict[str, str]:
    return {"axis": "virtual: a simulated joint, no hardware moved"} if walk.axis.virtual else {}


def sections(walk: Walk, gains: GainSet, model: AxisModel) -> dict[str, Callable[[], Iterator[Part]]]:
    """What makes the parts of each section, by its title, in the order of the page."""
    return {
        "The axis as identified": lambda: _identified(walk, model),
        "The law and its design": lambda: _design(gains, model),
        "The certificate": lambda: _certificate(gains),
        "Deployment": lambda: _deployment(walk),
        "Tracking": lambda: _tracking(walk),
    }


def _add(page: Page, walk: Walk, part: Part) -> None:
    if isinstance(part, str):
        page.sentence(part)
    elif isinstance(part, PageTable):
        page.table(part, folded=part.title.startswith(PASSED))
    else:
        page.figure(part)
        write_pictures(part, walk.path(PICTURES))


def verdict(walk: Walk) -> str:
    """What decided, in one sentence: the page is written only of an axis that kept what was promised."""
    deployment, certificate = read_json(walk.path(DEPLOYMENT)), read_json(walk.path(CERTIFICATE))
    came, promised = deployment["after"]["slow_mrad"], deployment["promised"]["slow_mrad"]
    loop_stands = describe_margins(certificate["observations"])
    return (
        f"the deployed gain set keeps its promise with {came:.4g} of {promised:.4g} mrad RMS on the slow sine; all "
        f"{len(certificate['checks'])} checks of its certificate hold{f'; {loop_stands}' if loop_stands else ''}."
    )


def _origin(walk: Walk) -> Origin:
    files: dict[str, Path | Sequence[Path]] = {"model": walk.path(MODEL), "gains": walk.path(GAINS)}
    files |= {"certificate": walk.path(CERTIFICATE), "deployment": walk.path(DEPLOYMENT)}
    files |= {"tracking": walk.path(TRACKING)}
    recorded = [*walk.path(RECORDINGS).glob("*"), *walk.path(RUNS).glob("*.mcap")]
    return Origin(files | {"recordings": sorted(recorded)}, walk.axis.config, walk.axis.nodes(), _facts(walk))


def _summary(page: Page, walk: Walk) -> None:
    """What happened, in sentences."""
    deployment, tracking = read_json(walk.path(DEPLOYMENT)), read_json(walk.path(TRACKING))["tracking"]
    certificate, relaxed = read_json(walk.path(CERTIFICATE)), read_json(walk.path(RELAXED))
    page.sentence(
        "The axis was identified by its own motion; a controller was computed for what was found, judged without "
        f"trusting the solver ({len(certificate['checks'])} checks, all passed), and tried on the axis."
    )
    if relaxed:
        page.sentence(f"The design was agreed to be relaxed: {relaxed['wish']} {relaxed['enough']:.3g}.")
    for refused in certificate.get("refused", ()):  # a folder of an earlier version has none
        page.sentence(
            f"A design in which position errors count with {refused['position_weight']:g} of their weight was refused: "
            f"{'; '.join(refused['failed'])}."
        )
    was = f"went from {deployment['before']['slow_mrad']:.4g} to" if deployment["before"] else "was"
    page.sentence(
        f"On the slow sine of the validation motion the error {was} {deployment['after']['slow_mrad']:.4g} mrad RMS; "
        f"{deployment['promised']['slow_mrad']:.4g} mrad was promised."
    )
    if "local" in tracking:
        page.sentence(
            f"Trajectory (19) is tracked with {tracking['local']['rms_error_mrad']:.4g} mrad RMS, at most "
            f"{tracking['local']['max_error_mrad']:.4g} mrad{_rough(tracking['local'])}."
        )


def _identified(walk: Walk, model: AxisModel) -> Iterator[Part]:
    axis = walk.axis
    truth = axis.joint if isinstance(axis, VirtualWalkAxis) else None
    found = read_json(walk.path(IDENTIFIED))
    rows = [
        (name, f"{v['value']:.5g}", f"{v['low']:.4g} to {v['high']:.4g}", v["unit"], v["note"])
        for name, v in found["identified"].items()
    ]
    yield PageTable("What was measured", ("quantity", "value", "95 % interval", "unit", "note"), tuple(rows))
    yield from (f"Not identifiable: {name}. {remedy}." for name, remedy in found["not_identifiable"].items())
    analysis = analyse(store.load(walk.path(RECORDINGS)))
    yield friction.dahl_curve(analysis.presliding, truth)
    yield loop.measured_response(analysis.response)
    yield friction.friction_map(model, truth)


def _design(gains: GainSet, model: AxisModel) -> Iterator[Part]:
    yield sets.weighting_functions(gains)
    yield sets.local_friction(gains, model)
    yield loop.bode(gains)
    yield loop.impulse_responses(gains)


def _certificate(gains: GainSet) -> Iterator[Part]:
    yield from loop.certificate_tables(gains)
    yield loop.observations_table(gains)


def _deployment(walk: Walk) -> Iterator[Part]:
    found = read_json(walk.path(DEPLOYMENT))
    yield from _trial(walk)
    if not found["before"]:
        yield "The set was active already, and nothing was measured before it: its promise alone judged it."
        return
    files = {"before": BEFORE_ROWS, "after": AFTER_ROWS}
    before, after = (motion.motion_of_rows(label, load_rows(walk.path(name))) for label, name in files.items())
    caption = f"Its parts as the table has them: {_parts('before', found)} {_parts('after', found)}"
    title = "The validation motion before and after"
    yield motion.before_after(before, after, title=title, caption=caption)


def _parts(run: str, found: dict[str, Any]) -> str:
    """The figures of one run of the validation motion."""
    parts = (f"{name.removesuffix('_mrad')} {found[run][name]:.4g} mrad" for name in found["promised"])
    return f"{run} {', '.join(parts)}."


def _tracking(walk: Walk) -> Iterator[Part]:
    found = read_json(walk.path(TRACKING))
    for name, title in CLASSES.items():
        if not (figures := found[name]):
            continue
        yield PageTable(f"{title}: trajectory (19) and steps, mrad and s", _HEADER, tuple(_rows(figures)))
        yield from _over_limit(figures)
        feedback = name.partition("_")[0]
        yield from _tuned(feedback, title, read_json(walk.path(TUNING)).get(feedback, {}))
        keys = {law: law if law == DEPLOYED else f"{feedback}_{law}" for law in figures if "failed" not in figures[law]}
        runs = {law: load_curves(run_files(walk, key)[1]) for law, key in keys.items()}
        yield from _figures(name, title, runs, figures)
    yield from (f"Not measured: {line}" for line in found.get("not_measured", []))


def _tuned(feedback: str, title: str, tuned: dict[str, Any]) -> Iterator[PageTable]:
    """What the tuning of a class reached on simulated plants, with the roughness that bounds every law alike."""
    if tuned:
        header = ("controller", "cost / mrad", "simulated plants", "roughness, times that of the paper's PD", "limit")
        rows = [
            (
                _label(law, t),
                f"{t['cost_mrad']:.4f}",
                str(t["simulations"]),
                f"{t['roughness_ratio']:.2f}",
                f"{t['roughness_limit']:g}",
            )
            for law, t in tuned.items()
        ]
        yield PageTable(f"{title}: what tuning reached", header, tuple(rows))


def _over_limit(figures: dict[str, Any]) -> Iterator[str]:
    """What the limit on roughness bounds, where the deployed law stands beside laws that were tuned within it."""
    found = figures.get(DEPLOYED, {})
    if "roughness_ratio" not in found:
        return
    yield (
        f"The laws were tuned with the roughness of the torque limited to {found['roughness_limit']:g} times what the "
        "paper's PD makes of encoder and noise. The deployed law was synthesized, and nothing but its certificate "
        f"bounds it: it runs{_rough(found).removeprefix(',')}. Law against law is the row of the local models."
    )


def _rough(found: dict[str, Any]) -> str:
    """A clause on the roughness of a law; empty where it was not compared."""
    if "roughness_ratio" not in found:
        return ""
    return (
        f", with {found['roughness_ratio']:.3g} times the roughness of the paper's PD, "
        f"{_against_limit(found) or 'within the limit'}"
    )


def _against_limit(found: dict[str, Any]) -> str:
    """By how much a law is over the limit on roughness; empty where it is not, or was not compared."""
    if found.get("within_roughness_limit", True):
        return ""
    return f"over the limit (x{found['roughness_ratio'] / found['roughness_limit']:.3g})"


def _label(law: str, found: dict[str, Any]) -> str:
    """A law as people read it, with the mark of one that is rougher than the tuned may be."""
    return ", ".join(filter(None, (NAMES[law], _against_limit(found))))


def _figures(name: str, title: str, runs: dict[str, dict[str, Curves]], figures: dict[str, Any]) -> Iterator[Figure]:
    motions = [_motion(law, curves["paper"]) for law, curves in runs.items()]
    yield motion.tracking_grid(motions, f"tracking_{name}", f"{title}: trajectory (19)", same_error_scale=False)
    scores = {NAMES[law]: figures[law]["rms_error_mrad"] for law in runs}
    yield motion.errors(motions, f"errors_{name}", f"{title}: errors on trajectory (19)", scores=scores)
    for step in STEPS_MRAD:
        key = curve_key(step)
        stepped = [_motion(law, curves[key]) for law, curves in runs.items() if key in curves]
        if stepped:
            yield motion.steps(stepped, f"{key}_{name}", f"{title}: step of {step:g} mrad")


def _motion(law: str, curves: Curves) -> PlottedMotion:
    return PlottedMotion(
        NAMES[law], curves.time_s, curves.reference_rad, curves.position_rad, curves.torque_nm, curves.friction_nm
    )


_HEADER = (
    "controller",
    "RMS",
    "largest",
    "roughness / mN*m per cycle",
    "times the paper's PD",
    "step / mrad",
    "settled after / s",
    "overshoot",
    "steady error",
    "hold",
)


def _rows(figures: dict[str, Any]) -> Iterator[tuple[str, ...]]:
    """A row for each law and step."""
    for law, f in figures.items():
        if "failed" in f:
            yield (_label(law, f), f["failed"], *[""] * (len(_HEADER) - 2))
            continue
        torque = (f"{1e3 * f['roughness_nm']:.3g}", f"{f['roughness_ratio']:.3g}" if "roughness_ratio" in f else "")
        head = (_label(law, f), f"{f['rms_error_mrad']:.4g}", f"{f['max_error_mrad']:.4g}", *torque)
        if not f["steps"]:
            yield (*head, *[""] * 5)
        for size, s in f["steps"].items():
            settled = "never" if s["settling_s"] is None else f"{s['settling_s']:.3f}"
            swing = " (limit cycle)" if s["limit_cycle"] else ""
            yield (
                *head,
                size,
                settled,
                f"{s['overshoot']:.1%}",
                f"{s['steady_error_mrad']:.4f}",
                f"{s['hold_mrad']:.4f}{swing}",
            )


# --- The document ----------------------------------------------------------------------------------------------------
# The one document of a commissioning: what was identified, certified, deployed and measured, and how long it took.
# `servoctl commission --json` prints it.


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
    walk.path(REFUSED).unlink(missing_ok=True)  # of an earlier attempt
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


# --- Step 7 ----------------------------------------------------------------------------------------------------------
# The last step of the walk: one page that shows all of it, and its pictures.


@dataclass(frozen=True)
class Report:
    """Leaves report.html and the pictures."""

    name: str = "report"
    title: str = "report"

    def outputs(self, _walk: Walk) -> tuple[str, ...]:
        """Files in the walk's folder."""
        return (REPORT, PICTURES)

    def inputs(self, walk: Walk) -> dict[str, Any]:
        """Everything that is shown."""
        return {**walk.hashes(IDENTIFIED, MODEL, GAINS, DEPLOYMENT, TRACKING, TUNING), "version": __version__}

    def run(self, walk: Walk) -> None:
        """From the folder's files alone."""
        with walk.progress(self.title) as on_progress:
            write_report(walk, on_progress)
