"""Every figure function on small data: what is plotted is what was given, and both renderers draw it."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from servod.common.errors import BadInput
from servod.common.shipped import shipped
from servod.formats.gains.gain_set import load_gains
from servod.formats.model.axis_model import AxisModel
from servod.formats.model.identified import Identified, IdentifiedMap
from servod.lab.identify.estimate import Estimate
from servod.lab.identify.fits.presliding import PreslidingFit
from servod.lab.identify.fits.response import ResponseFit
from servod.lab.report.figure import Figure, Style
from servod.lab.report.figures.friction import dahl_curve, friction_map
from servod.lab.report.figures.loop import bode, certificate_tables, observations_table
from servod.lab.report.figures.loop import measured_response as frequency_response
from servod.lab.report.figures.motion import (
    PlottedMotion,
    RecordedRun,
    before_after,
    describe_run,
    disturbed_friction,
    errors,
    position_and_friction,
    steps,
    tracking,
    tracking_grid,
)
from servod.lab.report.figures.sets import (
    local_friction,
    local_law,
    steady_compensation,
    weight_table,
    weighting_functions,
)
from servod.lab.report.page import Page, PageData, Verdict, figure_html
from servod.lab.report.pictures import write_pictures
from tests.lab.synthesize.designs import table1

TABLE1 = load_gains(shipped("gains/table1_kz_kv_kx.yaml"))


def motion(label: str, error_mrad: float, seconds: float = 3.0) -> PlottedMotion:
    t = np.arange(round(1000 * seconds)) * 1e-3
    reference = 0.1 * np.sin(t)
    torque = 0.07 * np.sign(np.cos(t))
    return PlottedMotion(
        label, t, reference, reference - 1e-3 * error_mrad * np.cos(40.0 * t), torque, 0.9 * torque, torque
    )


MOTIONS = [motion("first", 20.0), motion("second", 0.5)]


def identified_model() -> AxisModel:
    velocities = [-0.5, -0.1, -0.01, 0.01, 0.1, 0.5]
    torques = [-0.06, -0.05, -0.06, 0.08, 0.07, 0.09]
    found = IdentifiedMap(velocities=velocities, torques=torques, half_widths=[0.001] * 6)
    return table1().model_copy(update={"identified": Identified(values={}, friction_map=found)})


def presliding(c0: float = 950.0) -> PreslidingFit:
    phase = np.linspace(0.0, 2.0 * np.pi, 200, endpoint=False)
    torque = 0.028 * np.sin(phase)
    estimate = Estimate(c0, 0.97 * c0, 1.03 * c0, "N*m/rad")
    return PreslidingFit(estimate, 1.05, 0.028 / c0 * np.sin(phase - 0.3) + 1e-4, torque)


def sliding() -> ResponseFit:
    """The response of a rigid joint, five per cent off, as a multisine shows it."""
    hz, one = np.geomspace(3.0, 160.0, 12), Estimate(1e-3, 9e-4, 1.1e-3, "1")
    none = Estimate(0.0, 0.0, 0.0, "1")
    slope, delay_s = Estimate(-0.004, -0.005, -0.003, "1"), Estimate(2e-3, 1e-3, 3e-3, "s")
    fit = ResponseFit(one, slope, delay_s, none, None, hz, 0j * hz, np.full(12, 0.02), np.linspace(1.0, 0.4, 12), 1e-3)
    return fit._replace(response=1.05 * fit.model(hz))


def figures() -> list[Figure]:
    return [
        dahl_curve(presliding(), table1()),
        friction_map(identified_model(), table1()),
        frequency_response(sliding()),
        weighting_functions(TABLE1),
        local_friction(TABLE1, table1()),
        tracking(MOTIONS[0]),
        tracking_grid(MOTIONS),
        errors(MOTIONS),
        before_after(*MOTIONS),
        steps(MOTIONS, "steps", "Steps"),
        position_and_friction(MOTIONS, "friction", "Friction"),
        disturbed_friction(*MOTIONS),
    ]


@pytest.mark.parametrize("figure", figures(), ids=lambda f: f.name)
def test_the_page_has_every_curve_under_axes_with_units(figure: Figure) -> None:
    """Each curve stands in the page with its rows; every axis names its unit, or is a weight; labels stand once."""
    document, text = PageData([figure]).document(), figure_html(figure)
    for panel, held in zip(figure.panels, document["figures"][0]["panels"], strict=True):
        assert [c.label for c in panel.curves] == [c["label"] for c in held["curves"]]
        for axis in (panel.x, panel.y):
            assert re.search(r" in \S+", axis.label) or "weight" in axis.label
    labels = re.findall(r'aria-pressed="true"><svg.*?</svg>(.*?)</button>', text)
    assert len(labels) == len(set(labels))
    assert text.count('class="panel"') == len(figure.panels) and figure.title in text


def test_pictures_are_the_same_bytes_every_time(tmp_path: Path) -> None:
    first = {p.name: p.read_bytes() for p in write_pictures(tracking(MOTIONS[0]), tmp_path / "a")}
    second = {p.name: p.read_bytes() for p in write_pictures(tracking(MOTIONS[0]), tmp_path / "b")}
    assert sorted(first) == ["tracking.png", "tracking.svg"]
    assert first == second
    assert first["tracking.png"].startswith(b"\x89PNG") and b"</svg>" in first["tracking.svg"]


def test_a_folder_that_cannot_be_written_is_bad_input(tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("a file")
    with pytest.raises(BadInput, match="taken"):
        write_pictures(tracking(MOTIONS[0]), tmp_path / "taken", ("svg",))


def test_the_page_needs_no_network_and_holds_figure_and_caption(tmp_path: Path) -> None:
    page = Page("title", Verdict("it went well", True))
    page.figure(before_after(*MOTIONS))
    page.write(tmp_path / "page.html")
    text = (tmp_path / "page.html").read_text()
    assert "RMS error" in text and "page-data" in text and "Passed: it went well" in text
    assert not re.findall(r"<(?:script|link|img)[^>]+(?:src|href)=.https?:", text)


@pytest.mark.parametrize("name", ["table1_kz_kv_kx", "demo_local"])
def test_the_plotted_weights_sum_to_one(name: str) -> None:
    gains = load_gains(shipped(f"gains/{name}.yaml"))
    velocity = np.linspace(-0.7, 0.7, 501)
    table = weight_table(local_law(gains), velocity)
    assert np.all(table >= 0.0) and np.allclose(table.sum(axis=1), 1.0, atol=1e-12)
    whole, _ = weighting_functions(gains).panels
    assert len(whole.curves) == table.shape[1]
    assert np.allclose(sum(c.y for c in whole.curves), 1.0)


def test_the_dahl_curve_has_the_identified_slope() -> None:
    (panel,) = dahl_curve(presliding(700.0)).panels
    slope = next(c for c in panel.curves if c.label.startswith("c0 = 700"))
    assert np.ptp(slope.y) * 1e-3 / (np.ptp(slope.x) * 1e-6) == pytest.approx(700.0)


def test_the_frequency_response_shows_lines_model_and_coherence() -> None:
    gain, phase, coherence = frequency_response(sliding()).panels
    measured, fitted = gain.curves
    assert measured.y == pytest.approx(1.05 * np.interp(measured.x, fitted.x, fitted.y), rel=0.01)
    assert measured.bounds is not None and measured.bounds[1] == pytest.approx(1.0392 * measured.y)
    assert phase.curves[0].y == pytest.approx(np.interp(measured.x, fitted.x, phase.curves[1].y), abs=0.5)
    assert np.all(np.abs(np.diff(phase.curves[1].y)) < 10.0) and -270.0 < phase.curves[1].y[0] < -180.0
    assert coherence.curves[0].y[[0, -1]] == pytest.approx([100.0, 40.0])


def test_the_map_shows_both_directions_with_their_intervals() -> None:
    signed, by_speed = friction_map(identified_model(), table1()).panels
    for panel in (signed, by_speed):
        sides = [c for c in panel.curves if c.bounds is not None]
        assert len(sides) == 2
        for side in sides:
            assert side.bounds is not None
            low, high = side.bounds
            assert np.all(low < side.y) and np.all(side.y < high)
            assert high - low == pytest.approx(2.0, rel=1e-9)  # mN*m
    assert all(np.all(c.x > 0.0) and np.all(c.y > 0.0) for c in by_speed.curves)
    assert any(c.label == "plant" and c.style is Style.DASHED for c in signed.curves)


def test_a_model_that_nobody_identified_has_no_map() -> None:
    with pytest.raises(BadInput, match="identified"):
        friction_map(table1())


def test_the_sets_give_their_friction_at_their_nodes() -> None:
    """Steady compensation is (7) at v_i: c0*v/a_i + d0*v."""
    law = local_law(TABLE1)
    nodes = [s for s in law.friction.sets if s.velocity_rad_s]
    velocity = np.array([s.velocity_rad_s for s in nodes])
    c0, d0 = law.friction.stiffness_nm_per_rad, law.friction.viscous_nms_per_rad
    expected = np.array([c0 * s.velocity_rad_s / s.decay_per_s for s in nodes]) + d0 * velocity
    assert steady_compensation(law, velocity) == pytest.approx(expected, rel=1e-9)


def test_small_errors_get_a_scale_of_their_own() -> None:
    whole, fine = errors([motion("large", 20.0), motion("small", 0.5)]).panels
    assert [c.label for c in fine.curves] == ["small"]
    assert fine.y.span is not None and whole.y.span is not None
    assert fine.y.span[1] < 0.1 * whole.y.span[1]
    assert len(errors([motion("a", 1.0), motion("b", 0.9)]).panels) == 1


def test_a_part_of_a_motion_counts_from_its_own_start() -> None:
    part = MOTIONS[0].part(1.0, 2.0)
    assert part.time_s[0] == pytest.approx(0.0) and len(part.time_s) == 1000
    assert part.error_mrad == pytest.approx(MOTIONS[0].error_mrad[1000:2000])


def test_other_laws_and_bare_sets_are_refused() -> None:
    with pytest.raises(BadInput, match="local"):
        weighting_functions(load_gains(shipped("gains/paper_pd.yaml")))
    with pytest.raises(BadInput, match="design"):
        bode(TABLE1)
    for table in (lambda gains: list(certificate_tables(gains)), observations_table):
        with pytest.raises(BadInput, match="certificate"):
            table(TABLE1)


def test_a_recording_is_judged_where_the_axis_was_enabled_and_for_each_gain_set() -> None:
    """Disabled for two rows, then two 1 mrad off under gain set 1, and two 3 mrad off under gain set 2."""
    state = np.array([0, 0, 2, 2, 2, 2])
    columns = {
        "position_rad": np.array([5.0, 5.0, 0.001, 0.001, 0.003, 0.003]),
        "reference_rad": np.zeros(6),
        "axis_state": state,
        "controller": np.array([1, 1, 1, 1, 2, 2]),
    }
    states = (("axis_state", "axis", ("DISABLED", "ENABLING", "ENABLED")),)
    told = describe_run(RecordedRun("run", np.arange(6.0), columns, states=states))
    assert "RMS error 1 mrad, largest 1 mrad under gain set 1 of this run" in told
    assert "RMS error 3 mrad, largest 3 mrad under gain set 2 of this run" in told
    assert "never enabled" in describe_run(
        RecordedRun("run", np.arange(6.0), columns | {"axis_state": 0 * state}, states=states)
    )
