"""Statements of the paper are judged by numbers alone, and tables print what the document holds."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from servod.lab.report.figures.motion import PlottedMotion
from servod.lab.report.figures.sets import local_law
from servod.lab.synthesize.local_sets import force_after
from servod.lab.tracking.metrics import paper_rows
from servod.qualify.paper import table
from servod.qualify.paper.claims import Claim, ordered
from servod.qualify.paper.equations import compensator, equal_force_decay, exponent_of_18
from servod.qualify.paper.joints import (
    PaperJoint,
    at_paper_feedback,
    consistent_g,
    printed_g,
    printed_l,
    shipped_set,
    with_l,
)
from servod.qualify.paper.motions import SLOW_RAD_S, around_zero
from servod.qualify.paper.printed import L_I, NODES_RAD_S, RMS_MRAD
from servod.qualify.paper.results import Row
from servod.qualify.paper.sweeps import filtered_noise, joint_friction, on_sine, rms_mrad, simulate, sweep_of_l

PD, TABLE1 = shipped_set("paper_pd"), shipped_set("table1_kz_kv_kx")


def test_the_sentence_follows_the_numbers() -> None:
    falls = ordered([("a", 3.0), ("b", 2.0), ("c", 1.0)], "it falls")
    assert falls.agrees and str(falls).startswith("Agrees: it falls; here a 3 then b 2")
    rises = ordered([("a", 3.0), ("b", 4.0)], "it falls")
    assert not rises.agrees and str(rises).startswith("Does not agree: it falls")


def test_printed_l_are_the_sets_of_table_1() -> None:
    law = local_law(printed_l(TABLE1))
    assert [s.velocity_rad_s for s in law.friction.sets] == list(NODES_RAD_S)
    assert [s.gain for s in law.friction.sets] == list(L_I)


def test_at_the_papers_feedback_only_the_feedback_changes() -> None:
    law, own = local_law(at_paper_feedback(TABLE1, "equal")), local_law(TABLE1)
    assert law.friction == own.friction
    for region in (law.regions.low, law.regions.high):
        assert law.input_scale_nm * region.k_x_per_rad == pytest.approx(2.5)
        assert law.input_scale_nm * region.k_v_s_per_rad == pytest.approx(0.12)


def test_the_printed_exponent_lets_friction_grow() -> None:
    assert printed_g(0.0) == consistent_g(0.0) == pytest.approx(0.07)
    assert consistent_g(0.5) == pytest.approx(0.045)
    assert printed_g(0.5) > 1e6
    forms = exponent_of_18(4.0)
    assert forms.printed_mrad > 2.0 * forms.consistent_mrad


def test_literal_8_gives_every_set_the_same_force() -> None:
    c = compensator()
    decays = [equal_force_decay(c, 0.07, v) for v in (0.001, 0.05, 0.2)]
    forces = [force_after(c, a, v, 1.0) for a, v in zip(decays, (0.001, 0.05, 0.2), strict=True)]
    assert forces == pytest.approx([0.07] * 3, rel=1e-6)


def test_filtered_noise_has_the_asked_size_and_no_fast_part() -> None:
    noise = filtered_noise(0.004, 20_000, 3)
    assert float(np.sqrt(np.mean(noise**2))) == pytest.approx(0.004)
    assert float(np.std(np.diff(noise))) < 0.2 * 0.004
    assert np.array_equal(noise, filtered_noise(0.004, 20_000, 3))


def test_the_joints_friction_is_what_the_torque_overcomes() -> None:
    """Where the joint moves steadily, friction is that of Table I at its speed."""
    plant = PaperJoint.TABLE1.model()
    run = simulate(plant, TABLE1, paper_rows(1e-3, 2.0))
    at = slice(800, 1200)
    speed = float(np.mean(run.true_velocity_rad_s[at]))
    expected = consistent_g(speed) + 0.056 * speed
    assert float(np.mean(joint_friction(plant, run)[at])) == pytest.approx(expected, rel=0.05)


def test_noise_on_friction_is_in_the_friction_of_the_motion() -> None:
    calm, pushed = on_sine("calm", TABLE1, 2.0), on_sine("pushed", TABLE1, 2.0, 0.02, seed=5)
    assert calm.joint_friction_nm is not None and pushed.joint_friction_nm is not None
    assert float(np.std(pushed.joint_friction_nm - calm.joint_friction_nm)) > 0.01


def test_the_sweep_of_l_meets_the_run_without_it() -> None:
    sweep = sweep_of_l(with_l(TABLE1, "any", [0.3] * 9), 2.0, (0.01, 1.0))
    assert sweep.without == pytest.approx(rms_mrad(PaperJoint.TABLE1.model(), with_l(TABLE1, "none", [0.0] * 9), 2.0))
    assert sweep.rms_mrad["signs as printed"][1] > sweep.without


def tracked(rms: float | None) -> dict[str, Any]:
    stops = {} if rms is not None else {"(19)": "SPEED_LIMIT"}
    return {"rms_error_mrad": rms, "max_error_mrad": rms, "roughness_nm": rms, "steps": {}, "stops": stops}


def document() -> dict[str, Any]:
    rows = {row.name.lower(): tracked(1.0 + i) for i, row in enumerate(Row)} | {"table1_other": tracked(None)}
    gains = {"position_nm_per_rad": 100.0, "velocity_nms_per_rad": 0.5}
    sigma0 = {"value": 940.0, "low": 920.0, "high": 960.0, "unit": "N*m/rad", "note": ""}
    joint = {
        "identified": {"sigma0": sigma0},
        "feedback": {"low": gains, "high": gains},
        "tracking": rows,
        "tuned": [{"law": "pd", "feedback": "equal", **tracked(2.5)}],
    }
    claim = {"paper": "says", "here": "finds", "agrees": False}
    return {
        "joints": {"table1_joint": joint},
        "figures": [{"number": "2", "where": "", "claims": [claim]}],
        "statements": [{"about": "equations", **claim}],
    }


def test_the_table_puts_ours_beside_the_papers() -> None:
    printed = table.numbers(json.loads(json.dumps(document())))
    assert tuple(row[0] for row in printed.rows) == table.QUANTITIES
    by_name = {row[0]: row[1:] for row in printed.rows}
    assert by_name["RMS on (19) / mrad: PD + DOB, 50 rad/s"] == (f"{RMS_MRAD['pd_dob']:g}", "2.0000")
    assert by_name["RMS on (19) / mrad: Table I as (K_x, K_v, K_z)"][1] == "stopped: SPEED_LIMIT"
    assert by_name["σ0 / N·m/rad"] == ("950", "940 (920 to 960)")
    assert by_name["m / g·m²"] == ("1", "–")
    assert printed.markdown().startswith("| quantity | paper | Table I's joint |\n| --- | --- | --- |\n")


def test_every_claim_and_every_rival_is_in_a_table() -> None:
    assert [row[3] for row in table.claims(document()).rows] == ["does not agree"] * 2
    rival, deployed = table.tuned(document(), PaperJoint.TABLE1).rows
    assert rival[:3] == ("pd", "equal", "2.5000")
    assert deployed == ("local, synthesized", table.UNLIMITED, "11.0000", "11.000", "1.1e+04")
    first, *_ = table.steps(document(), PaperJoint.TABLE1).rows
    assert first == ("PD", *("–",) * 6)


def test_a_claim_is_its_two_halves() -> None:
    assert str(Claim("x", "y", True)) == "Agrees: x; here y."


def test_an_error_around_zero_velocity_is_told_from_one_elsewhere() -> None:
    """A reference that stands still at its ends: an error there alone agrees, one everywhere else does not."""
    t = np.arange(10_000) * 1e-3
    reference, speed = 0.05 * np.sin(0.2 * np.pi * t), 0.01 * np.pi * np.abs(np.cos(0.2 * np.pi * t))
    slow = speed < SLOW_RAD_S
    for wrong, agrees in ((slow, True), (~slow, False)):
        nothing = np.zeros_like(t)
        motion = PlottedMotion("x", t, reference, reference - 1e-3 * wrong, nothing, nothing)
        assert around_zero(motion).agrees is agrees
