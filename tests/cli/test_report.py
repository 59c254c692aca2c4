"""Runs, their scores, and the page of the demo."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from servod.common.errors import AnswerIsNo, BadInput
from servod.common.shipped import shipped
from servod.formats.gains.gain_set import load_gains
from servod.lab.recordings.recording import ROW
from servod.lab.report.figure import thin
from servod.qualify.demo.axis import CONTROLLERS
from servod.qualify.demo.entries import entries
from servod.qualify.demo.report import Story, write_demo_page
from servod.qualify.demo.runs import Run, cut_motion, summary

PERIOD_NS = 1_000_000


def recorded(error_rad: float, seconds: float = 3.0, still: int = 100) -> np.ndarray:
    """Cycle records: `still` cycles at rest, then a motion that is off by `error_rad`, ten times that in second one."""
    moving = round(seconds * 1000)
    rows = np.zeros(still + moving, dtype=ROW)
    rows["cycle"] = np.arange(len(rows))
    rows["time_ns"] = 5_000_000_000 + rows["cycle"] * PERIOD_NS
    rows["reference_active"][still:] = 1
    t = np.arange(moving) * 1e-3
    rows["reference_rad"][still:] = 0.1 * np.sin(t)
    rows["position_rad"][still:] = 0.1 * np.sin(t) - error_rad * np.where(t < 1.0, 10.0, 1.0)
    rows["torque_nm"][still:] = 0.05 * np.cos(t)
    rows["lag_ns"] = 20_000
    rows["torque_sent_ns"] = 100_000
    return rows


def test_score_leaves_out_rest_and_first_second() -> None:
    score = cut_motion("pd", recorded(0.002).tobytes()).score()
    assert score.rms_error_mrad == pytest.approx(2.0)
    assert score.max_error_mrad == pytest.approx(2.0)


def test_score_is_of_the_encoder_and_signed_errors_do_not_cancel() -> None:
    rows = recorded(0.0)
    rows["position_rad"][-2000::2] += 0.003
    rows["position_rad"][-2001::2] -= 0.003
    assert cut_motion("pd", rows.tobytes()).score().rms_error_mrad == pytest.approx(3.0, rel=1e-3)


def test_a_run_without_motion_is_no_run() -> None:
    with pytest.raises(AnswerIsNo, match="no motion"):
        cut_motion("pd", recorded(0.0, seconds=0.0).tobytes())


def test_a_run_shorter_than_its_first_second_has_no_score() -> None:
    with pytest.raises(AnswerIsNo, match="first 1 s"):
        cut_motion("pd", recorded(0.0, seconds=0.5).tobytes()).score()


def test_summary_has_its_keys_and_counts_skipped_periods() -> None:
    rows = recorded(0.001)
    rows["missed"][-1000:] = 7
    rows["cycle"][-1000:] += 7
    document = summary([cut_motion(c, rows.tobytes()) for c in CONTROLLERS], 1.5)
    assert set(document) == {"controllers", "cycles", "missed", "wall_s"}
    assert set(document["controllers"]) == {"pd", "pd_dob", "pd_lugre", "local"}
    assert set(document["controllers"]["pd"]) == {"rms_error_mrad", "max_error_mrad"}
    assert (document["missed"], document["cycles"]) == (28, 4 * 3007)


def test_captions_have_the_figures_of_the_document(tmp_path: Path) -> None:
    rows, raw = entries(), [recorded(0.001 * (i + 1)).tobytes() for i in range(len(CONTROLLERS))]
    runs = [cut_motion(c, r) for c, r in zip(CONTROLLERS, raw, strict=True)]
    write_demo_page(rows, runs, tmp_path / "report.html", Story("joint", True))
    text = (tmp_path / "report.html").read_text()
    known = {f"{s['rms_error_mrad']:.3f}" for s in summary(runs, 1.0)["controllers"].values()}
    captions = re.findall(r"<figcaption>(.*?)</figcaption>", text)
    told = re.findall(r"([\d.]+) mrad", " ".join(captions))
    assert captions and set(told) == known
    assert set(re.findall(r"([\d.]+) mrad", re.findall(r'id="verdict".*?</p>', text)[0])) <= known


def test_further_runs_stand_apart_from_the_four_controllers() -> None:
    raw = recorded(0.001).tobytes()
    document = summary([cut_motion(c, raw) for c in (*CONTROLLERS, "demo_local_plain")], 1.5)
    assert list(document["controllers"]) == list(CONTROLLERS)
    assert list(document["others"]) == ["demo_local_plain"]
    assert document["cycles"] == 4 * 3000


def test_every_row_says_what_its_law_had() -> None:
    rows = {row.name: row.options for row in entries([shipped("gains/demo_local_plain.yaml")])}
    assert rows["pd"] == "none"
    assert rows["pd_dob"] == "observer 50 rad/s"
    assert rows["local"] == "friction map of 23 velocities, reference velocity, observer 50 rad/s, equal feedback"
    assert rows["demo_local_plain"] == "friction map of 23 velocities, measured velocity, no observer, equal feedback"


def test_the_certified_set_is_the_last_row_and_says_what_it_stands(tmp_path: Path) -> None:
    rows = entries([shipped("gains/demo_local_plain.yaml")], certified=True)
    last = rows[-1]
    assert [row.name for row in rows[-2:]] == ["demo_local_plain", "local_certified"]
    assert "certified" in last.label and "torque over position fed forward" in last.options
    assert last.margins is not None and all(row.margins is None for row in rows[:-1])
    runs = [cut_motion(row.name, recorded(0.001).tobytes()) for row in rows]
    write_demo_page(rows, runs, tmp_path / "report.html", Story("joint", True))
    text = (tmp_path / "report.html").read_text()
    assert f"{last.label}: {last.margins}." in text
    assert f"under {len(rows)} controllers" in text and "four" not in text.partition("<script")[0]
    assert "PD, PD + DOB, PD + LuGre and Local models have the same PD feedback." in text


def test_a_set_of_another_loop_is_refused_before_anything_runs(tmp_path: Path) -> None:
    """The stepped demo ran it with a velocity filter that it was not designed for; the daemon refuses it."""
    gains = load_gains(shipped("gains/demo_local_certified.yaml"))
    assert gains.design is not None
    design = gains.design.model_copy(update={"velocity_cutoff_hz": 300.0})
    other = gains.model_copy(update={"name": "other", "certificate": None, "design": design})
    file = tmp_path / "other.yaml"
    file.write_text(other.sealed().to_yaml())
    with pytest.raises(BadInput, match="velocity_cutoff_hz"):
        entries([file])


def test_a_row_is_not_given_twice() -> None:
    plain = shipped("gains/demo_local_plain.yaml")
    with pytest.raises(BadInput, match="found demo_local_plain"):
        entries([plain, plain])


def test_the_page_names_options_and_refused_rights(tmp_path: Path) -> None:
    rows = entries([shipped("gains/demo_local_plain.yaml")])
    runs = [cut_motion(row.name, recorded(0.001).tobytes()) for row in rows]
    write_demo_page(rows, runs, tmp_path / "report.html", Story("joint", False, ["sched_fifo (not permitted)"]))
    text = (tmp_path / "report.html").read_text()
    assert all(re.search(f">{re.escape(row.label)}</th>.*{re.escape(row.options)}</td>", text) for row in rows)
    assert "refused the loop real-time rights: sched_fifo (not permitted)." in text


def test_thinning_keeps_ends_and_peaks() -> None:
    t = np.linspace(0.0, 1.0, 100_000)
    y = np.sin(40.0 * t)
    y[31_337], y[70_001] = 9.0, -8.0
    x, thinned = thin(t, y)
    assert len(x) <= 1800
    assert (thinned.max(), thinned.min()) == (9.0, -8.0)
    assert np.all(np.diff(x) > 0.0)


@pytest.mark.parametrize("stepped", [False, True])
def test_the_page_is_whole_and_needs_no_network(tmp_path: Path, stepped: bool) -> None:
    runs: list[Run] = [cut_motion(c, recorded(0.001 * (i + 1)).tobytes()) for i, c in enumerate(CONTROLLERS)]
    page = tmp_path / "deep" / "report.html"
    write_demo_page(entries(), runs, page, Story("a <joint>", stepped))
    text = page.read_text()
    assert "PD leaves 1.000 mrad RMS of tracking error on a joint that sticks, and no other controller less." in text
    assert "a &lt;joint&gt;" in text
    assert text.count("<figure ") == 1 + len(runs) + (0 if stepped else 2)
    body = re.sub(r"<script>.*?</script>", "", text.replace("\n", " "), count=1)
    assert not re.search(r"<(script|link|img)[^>]*(src|href)=", text)
    assert '<h1 id="title">servod demo' in body and "http" not in text.replace("http://www.w3.org", "")
    assert list(page.parent.iterdir()) == [page]


def test_half_a_minute_under_every_controller_is_a_small_page(tmp_path: Path) -> None:
    rows, run = entries(), cut_motion("pd", recorded(0.001, seconds=30.0).tobytes())
    page = tmp_path / "report.html"
    write_demo_page(rows, [Run(row.name, run.rows) for row in rows], page, Story("joint", True))
    assert page.stat().st_size < 3e6


def test_good_controllers_are_shown_apart_from_pd(tmp_path: Path) -> None:
    runs = [cut_motion(c, recorded(0.1 if c == "pd" else 0.001).tobytes()) for c in CONTROLLERS]
    page = tmp_path / "report.html"
    write_demo_page(entries(), runs, page, Story("joint", True))
    found = re.search(r'id="page-data">(.*?)</script>', page.read_text())
    assert found
    figures = {figure["name"]: figure["panels"] for figure in json.loads(found[1])["figures"]}
    labels = {name: [c["label"] for c in panels[0]["curves"]] for name, panels in figures.items()}
    assert labels["errors"] == ["PD", "PD + DOB", "PD + LuGre", "Local models"]
    assert labels["small_errors"] == ["PD + DOB", "PD + LuGre", "Local models"]
    assert figures["small_errors"][0]["y"]["span"] == pytest.approx([-1.1, 1.1])
    # Equal times stand below each other, and are zoomed together.
    assert len({json.dumps(panel["x"]) for panels in figures.values() for panel in panels}) == 1
