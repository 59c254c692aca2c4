"""Real steps from a known model to a deployed set: bit for bit the same after interruptions, and told on one page."""

from __future__ import annotations

import html
import json
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from servod.client.open import VirtualWalkAxis
from servod.common.errors import AnswerIsNo
from servod.common.progress import OnProgress
from servod.formats.gains.gain_set import GainSet, load_gains
from servod.formats.model.axis_model import axis_model_yaml
from servod.lab.commission import walk
from servod.lab.commission.comparison import load_curves, load_rows, save_curves
from servod.lab.commission.report import failure, sections, verdict, write_refusal
from servod.lab.commission.state import (
    CERTIFICATE,
    DEPLOYMENT,
    GAINS,
    MODEL,
    RELAXED,
    RUNS,
    TRACKING,
    TUNING,
    file_sha256,
    write_json,
    write_text,
)
from servod.lab.commission.state import read_walk_json as read_json
from servod.lab.commission.steps import STEPS as ALL_STEPS
from servod.lab.commission.steps.deploy import Deploy
from servod.lab.commission.steps.synthesize import NO_DESIGN, Synthesize, Verify, agreed, relaxed, report_clashes
from servod.lab.commission.steps.validate import document as comparison
from servod.lab.commission.walk import Outlook, Questions, Step, StepFailed, Walk, WalkOptions, run
from servod.lab.deploy.deployment import motion_notice
from servod.lab.report.figure import Figure, PageTable
from servod.lab.synthesize.deployed import Wishes
from servod.lab.synthesize.infeasible import Infeasible, Relaxation
from servod.lab.synthesize.regions import narrowed
from servod.lab.tracking import metrics
from servod.lab.verify.certify import Verification
from servod.lab.verify.checks import at_most
from servod.lab.verify.effect_checks import PHYSICS_CHECK
from tests.lab.synthesize.designs import table1

pytestmark = pytest.mark.timeout(400)  # some 16 s on a quiet core; a busy machine is no finding
AXIS = VirtualWalkAxis(table1(), seed=1)


@dataclass(frozen=True)
class Known:
    """In place of an identification: the model is known, as when it came from a file."""

    name: str = "known"
    title: str = "known"

    def outputs(self, _walk: Walk) -> tuple[str, ...]:
        return (MODEL,)

    def inputs(self, _walk: Walk) -> dict[str, Any]:
        return {}

    def run(self, walk: Walk) -> None:
        write_text(walk.path(MODEL), axis_model_yaml(table1()))


STEPS: tuple[Step, ...] = (Known(), Synthesize(), Verify(), Deploy())


def walk_in(folder: Path, interrupted: str = "") -> Walk:
    """A walk with few plants; `interrupted` names the step whose progress brings Ctrl-C."""

    @contextmanager
    def progress(title: str) -> Iterator[OnProgress]:
        def on_progress(_what: str, share: float) -> None:
            if title == interrupted and share > 0.05:
                raise KeyboardInterrupt

        yield on_progress

    options = WalkOptions(plants=2, processes=1, least_plants=2)
    return Walk(folder, AXIS, options, Questions(True, lambda _q: True), progress, lambda _line: None)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder whose walk was interrupted in every step and taken up."""
    folder = tmp_path_factory.mktemp("walk")
    for step in STEPS[1:]:
        with pytest.raises(KeyboardInterrupt):
            run(walk_in(folder, interrupted=step.title), STEPS)
    run(walk_in(folder), STEPS)
    return folder


def test_the_set_is_deployed_and_its_runs_are_kept(folder: Path) -> None:
    found = read_json(folder / DEPLOYMENT)
    assert found["deployed"] and found["present"]["name"] == "identification"
    assert found["after"]["slow_mrad"] < found["before"]["slow_mrad"]
    assert len(load_rows(folder / RUNS / "deploy_after.mcap")) > 12_000
    assert read_json(folder / RELAXED) is None


def test_made_again_every_file_is_the_same_byte_for_byte(folder: Path) -> None:
    names = [GAINS, DEPLOYMENT]
    before = [file_sha256(folder / name) for name in names]
    for name in names:
        (folder / name).unlink()
    run(walk_in(folder), STEPS)
    assert [file_sha256(folder / name) for name in names] == before


def test_a_relaxation_changes_its_own_wish_alone() -> None:
    wishes = Wishes()
    smaller = relaxed(table1(), wishes, Relaxation("scale of the uncertainty", 1.0, 0.5))
    assert smaller.uncertainty == narrowed(wishes.uncertainty, 0.49, table1()) != wishes.uncertainty
    slower = relaxed(table1(), wishes, Relaxation("least decay [1/s]", wishes.least_decay_per_s, 2.0))
    assert slower.least_decay_per_s == pytest.approx(1.96) and slower.uncertainty == wishes.uncertainty


def test_no_design_is_for_more_speed_than_the_axis_may_have_or_was_identified_with(tmp_path: Path) -> None:
    def loop(options: WalkOptions, limit_rad_s: float) -> dict[str, Any]:
        limits = AXIS.config.limits.model_copy(update={"speed_rad_s": limit_rad_s})
        axis = replace(AXIS, chosen=AXIS.config.model_copy(update={"limits": limits}))
        found: dict[str, Any] = Synthesize().inputs(replace(walk_in(tmp_path), axis=axis, options=options))["loop"]
        assert found["overlap"][0] < found["overlap"][1] < found["speed_max"]
        return found

    assert loop(WalkOptions(), 3.0)["speed_max"] == 0.5
    assert loop(WalkOptions(), 0.2)["speed_max"] == 0.2
    assert loop(WalkOptions(speed_rad_s=0.1), 0.2)["speed_max"] == 0.1
    assert loop(WalkOptions(speed_rad_s=0.02), 0.2)["speed_max"] == 0.02


def test_what_is_announced_of_a_trial_goes_with_the_design(folder: Path) -> None:
    gains = load_gains(folder / GAINS)
    assert gains.design is not None
    assert motion_notice(gains).startswith("sines and steps of up to 20.1 mrad to each side, sines at up to 0.25 rad/s")
    slower = gains.model_copy(update={"design": gains.design.model_copy(update={"speed_max_rad_s": 0.1})})
    assert motion_notice(slower).startswith(
        "sines and steps of up to 4.01 mrad to each side, sines at up to 0.05 rad/s"
    )


def test_what_is_offered_is_taken_by_yes_or_a_person_alone_also_on_a_virtual_axis(tmp_path: Path) -> None:
    offer = Relaxation("least decay [1/s]", 5.0, 2.0)
    clash = Infeasible(("low",), (), (offer,))
    nobody = Questions(False, lambda _q: True, person=lambda: False)
    with pytest.raises(AnswerIsNo, match=r"least decay.*--yes"):
        agreed(replace(walk_in(tmp_path), questions=nobody), clash)
    for questions in (Questions(True, lambda _q: False), Questions(False, lambda _q: True, person=lambda: True)):
        assert agreed(replace(walk_in(tmp_path), questions=questions), clash) == offer


def test_a_step_that_says_no_is_named_in_the_document(folder: Path) -> None:
    document = failure(walk_in(folder), StepFailed("deploy", "rolled back"))
    assert document["failed"] == {"step": "deploy", "message": "rolled back"}
    assert document["deployment"] == read_json(folder / DEPLOYMENT)


def test_a_walk_without_a_valid_set_has_a_page_that_says_why(folder: Path, tmp_path: Path) -> None:
    """Its verdict is the refusal, its first table the checks that failed; files of later steps are not of this walk."""
    shutil.copytree(folder, tmp_path / "walk")
    here = walk_in(tmp_path / "walk")
    found = read_json(here.path(CERTIFICATE))
    found["valid"] = found["checks"][3]["passed"] = False
    here.path(CERTIFICATE).write_text(json.dumps(found))
    for step, parts in (("deploy", "Deployment"), ("verify", "What the checks found")):
        page = write_refusal(here, StepFailed(step, f"{step}: not valid: {found['checks'][3]['name']}"))
        assert page == here.path("refused.html")
        text = page.read_text()
        told = f"Refused: {step}: not valid: {found['checks'][3]['name']}."
        assert f'<p id="verdict" class="failed">{html.escape(told)}</p>' in text
        assert re.findall("<h2>(.*?)</h2>", text)[0].startswith(parts)
        failed = re.search('<tr class="failed"><th scope="row">(.*?)</th>', text)
        assert (failed and failed[1]) == (html.escape(found["checks"][3]["name"]) if step == "verify" else None)
        assert ("deployment: " in text, "gain set: " in text) == ((step == "deploy"),) * 2
    assert "Deployment" not in text and "deployment: " not in text
    assert write_refusal(walk_in(tmp_path / "empty"), StepFailed("identify", "the axis does not move")) is None


def test_a_set_that_the_checks_refuse_gives_way_to_one_of_less_gain(folder: Path, tmp_path: Path, monkeypatch) -> None:
    """The next of the ladder is designed for the same model; what was refused before, and why, is kept."""
    shutil.copytree(folder, tmp_path / "walk")
    told: list[str] = []
    here = replace(walk_in(tmp_path / "walk"), say=told.append)
    gains_before = load_gains(here.path(GAINS))

    def refuse(name: str, below: float) -> None:
        def judge(gains: GainSet, *_how: object, **_options: object) -> Verification:
            weight = gains.design.regions[0].position_weight
            return Verification([at_most(name if weight >= below else "all else", weight, below)], {})

        monkeypatch.setattr("servod.lab.commission.steps.synthesize.verify", judge)

    refuse("pushed off a sine", 0.5)
    Verify().run(here)
    found, gains = read_json(here.path(CERTIFICATE)), load_gains(here.path(GAINS))
    assert found["valid"] and found["position_weight"] == 0.3
    assert found["refused"] == [{"position_weight": 1.0, "failed": ["pushed off a sine"]}]
    high, high_before = gains.parameters.regions.high, gains_before.parameters.regions.high
    assert high.k_x_per_rad < 0.6 * high_before.k_x_per_rad
    assert gains.design.model == gains_before.design.model
    assert told[0] == "verify: not valid: pushed off a sine"

    refuse("swings", 0.01)
    monkeypatch.setattr("servod.lab.commission.steps.synthesize.synthesize", lambda *_: Infeasible((), (), ()))
    with pytest.raises(AnswerIsNo, match=r"^verify: not valid: swings, and none with less position gain"):
        Verify().run(here)
    refused = failure(here, StepFailed("verify", "no"))["certificate"]["refused"]
    assert [entry["failed"] for entry in refused] == [["swings"], [NO_DESIGN], [NO_DESIGN]]

    refuse(PHYSICS_CHECK, 0.01)
    told.clear()
    with pytest.raises(AnswerIsNo, match=f"^verify: not valid: {PHYSICS_CHECK}$"):
        Verify().run(here)
    assert len(told) == 1  # less gain does not mend that, and nothing more is designed


def test_clashing_vertices_are_told_and_stand_in_the_document(tmp_path: Path) -> None:
    told: list[str] = []
    here = replace(walk_in(tmp_path), say=told.append)
    clashes = ("low: sticking soft: poles at 1.200 of the disc (1 allowed)", "low: sliding falling: poles at 1.1")
    report_clashes(here, Infeasible(("low",), clashes, (Relaxation("least decay [1/s]", 5.0, 2.0),)))
    assert told == [f"clash: {line}" for line in clashes]
    found = failure(here, StepFailed("synthesize", "no feedback"))["infeasible"]
    assert found["regions"] == ["low"] and found["clashes"] == list(clashes)
    assert found["relaxations"] == [{"wish": "least decay [1/s]", "asked": 5.0, "enough": 2.0}]


def test_curves_come_back_from_disk_and_stand_on_the_page(folder: Path) -> None:
    gains = load_gains(folder / GAINS)
    assert gains.design is not None
    cutoff_hz = gains.design.velocity_cutoff_hz
    run_of = metrics.measure(table1(), gains, counts_per_turn=2.0**20, cutoff_hz=cutoff_hz, seed=7)
    save_curves(folder / RUNS / "deployed.npz", run_of.curves)
    save_curves(folder / RUNS / "free_local.npz", run_of.curves)
    again = load_curves(folder / RUNS / "deployed.npz")
    assert again["paper"].error_mrad == pytest.approx(run_of.curves["paper"].error_mrad, abs=1e-3)
    cost = {"cost_mrad": 0.1, "simulations": 3}
    tuning = {"free": {"local": cost | judged(4.2), "deployed": cost | judged(10.0)}}
    write_json(folder / TRACKING, comparison({"free_local": run_of.document()}, run_of.document(), tuning))
    write_json(folder / TUNING, tuning)
    walk = walk_in(folder)
    made = {title: list(parts()) for title, parts in sections(walk, gains, table1()).items() if title in SHOWN}
    assert set(made) == SHOWN
    figures = {part.name for parts in made.values() for part in parts if isinstance(part, Figure)}
    assert {"bode", "impulse_responses", "weighting_functions", "before_after", "step_100_free_feedback"} <= figures
    captions = [p.caption for title in ("Deployment", "Tracking") for p in made[title] if isinstance(p, Figure)]
    known = {f"{v:.4g}" for name in (DEPLOYMENT, TRACKING) for v in leaves(read_json(folder / name))}
    told = [
        n for text in [*captions, verdict(walk)] for n in re.findall(r"([\d.]+(?:e-\d+)?)(?: of [\d.]+)? mrad", text)
    ]
    assert len(told) > 6 and set(told) <= known
    (reached,) = (p for p in made["Tracking"] if isinstance(p, PageTable) and "tuning reached" in p.title)
    over = "Deployed, over the limit (x2)"
    assert [(row[0], *row[3:]) for row in reached.rows] == [("Local models", "4.20", "5"), (over, "10.00", "5")]
    (compared,) = (p for p in made["Tracking"] if isinstance(p, PageTable) and "mrad and s" in p.title)
    assert {(row[0], row[4]) for row in compared.rows} == {("Local models", "4.2"), (over, "10")}
    (said,) = (p for p in made["Tracking"] if isinstance(p, str))
    assert "10 times the roughness of the paper's PD, over the limit (x2)" in said
    assert any(isinstance(part, PageTable) and "Certificate" in part.title for part in made["The certificate"])


def leaves(document: Any) -> Iterator[float]:
    """Every number of a JSON document."""
    if isinstance(document, dict | list):
        for part in document.values() if isinstance(document, dict) else document:
            yield from leaves(part)
    elif isinstance(document, float | int):
        yield float(document)


def judged(ratio: float) -> dict[str, Any]:
    """What tuning tells of a law with `ratio` times the roughness of the paper's PD."""
    return {"roughness_ratio": ratio, "roughness_limit": 5.0, "within_roughness_limit": ratio <= 5.0}


def test_the_deployed_law_is_never_taken_for_one_that_was_tuned_within_the_limit() -> None:
    figures = {"free_local": {"rms_error_mrad": 0.01}, "equal_local": {"rms_error_mrad": 0.03}}
    tuning = {"free": {"local": judged(4.9), "deployed": judged(10.0)}, "equal": {"local": judged(3.0)}}
    found = comparison(figures, {"rms_error_mrad": 0.005}, tuning)
    tuned = {"rms_error_mrad": 0.01, "tuned": True, **judged(4.9)}
    deployed = {"rms_error_mrad": 0.005, "tuned": False, **judged(10.0)}
    assert found["free_feedback"] == {"local": tuned, "deployed": deployed}
    assert found["tracking"] == {"local": deployed}
    assert found["equal_feedback"]["local"]["within_roughness_limit"]


def test_a_law_that_stands_alone_says_no_roughness_limit() -> None:
    found = comparison({}, {"rms_error_mrad": 0.005}, {})
    assert found["tracking"] == {"local": {"rms_error_mrad": 0.005, "tuned": False}}


#: Sections that need no recordings of an identification.
SHOWN = {"The law and its design", "The certificate", "Deployment", "Tracking"}


def test_what_is_left_follows_the_pace_of_the_steps_that_ended() -> None:
    now = [0.0]
    outlook = Outlook(("identify", "deploy", "report"), {"deploy": 20.0}, lambda: now[0])
    assert outlook.begin("identify") == "step 1 of 3"
    assert outlook.left_s() == 70.0 and outlook.left() == "about 70 s left"
    now[0] = 20.0
    assert outlook.left_s(0.05) == 50.0  # too early to believe a share
    assert outlook.left_s(0.25) == 90.0 and outlook.left(0.25) == "about 2 min left"
    now[0] = 80.0
    assert outlook.left_s(1.0) == 30.0
    outlook.end()
    assert outlook.begin("deploy") == "step 2 of 3"
    assert outlook.left_s() == 60.0  # twice as slow as usual
    now[0] = 500.0
    assert outlook.left_s() == 20.0 and outlook.left_s(float("nan")) == 20.0


def test_every_step_of_the_walk_has_a_usual_time() -> None:
    assert set(walk._USUAL_S) == {step.name for step in ALL_STEPS}


def test_the_progress_says_which_step_it_is_and_what_is_left(tmp_path: Path) -> None:
    told: list[str] = []

    @contextmanager
    def progress(_title: str) -> Iterator[OnProgress]:
        yield lambda what, _share: told.append(what)

    @dataclass(frozen=True)
    class Telling(Known):
        def run(self, walk: Walk) -> None:
            with walk.progress(self.title) as on_progress:
                on_progress("moving", 0.0)
            super().run(walk)

    said: list[str] = []
    run(replace(walk_in(tmp_path), progress=progress, say=said.append), (Telling(),))
    assert told == ["moving (step 1 of 1, about 20 s left)"]
    assert said[0] == "step 1 of 1: known, about 20 s left"
