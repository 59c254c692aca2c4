"""Certificates: what a good set gets, and that every kind of change is seen."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import numpy as np
import pytest

from servod.common.errors import BadInput
from servod.common.sources import VERIFIES, sources
from servod.formats.gains.gain_set import CertificateCheck, GainSet, load_gains, parse_gains
from servod.lab.verify.certify import Verification, verify
from servod.lab.verify.checks import Subject, check_loop, check_monte_carlo, check_regions, check_seal
from servod.lab.verify.trials import monte_carlo
from tests.lab.synthesize.designs import MODEL, table1_set


def subject(gains: GainSet) -> Subject:
    assert gains.design is not None
    return Subject(gains, gains.design, 4, 1, 1)


def changed(path: tuple[Any, ...], factor: float) -> GainSet:
    """The set with one number changed and sealed again, as somebody who knows of the seal would."""
    data = table1_set().model_dump(mode="json", exclude_none=True)
    here = data
    for key in path[:-1]:
        here = here[key]
    here[path[-1]] *= factor
    return GainSet.model_validate(data).sealed()


def test_a_synthesized_set_is_certified_and_the_daemon_takes_it() -> None:
    result = verify(table1_set(), plants=6, processes=1, least_plants=6)
    assert result.valid, [check for check in result.checks if not check.passed]
    certified = parse_gains(result.certified(table1_set()).to_yaml(), "set")
    assert certified.certificate_problem() is None
    assert result.observations["largest tolerated delay [s]"] > 0.001


def test_few_plants_make_no_certificate() -> None:
    failed = [check.name for check in check_monte_carlo(subject(table1_set())) if not check.passed]
    assert failed == ["plants of the Monte-Carlo"]


def test_a_broken_seal_is_not_mended_by_a_verification() -> None:
    meddled = table1_set().model_copy(update={"name": "other"})
    judged = Verification([CertificateCheck(name="seal", value=1.0, limit=0.0, margin=-1.0, passed=False)], {})
    assert judged.certified(meddled).seal_broken and not judged.certified(table1_set()).seal_broken


def test_the_tool_is_what_the_verification_stands_on() -> None:
    names = {f"{path.parent.name}/{path.name}" for path in sources(VERIFIES)}
    assert {"verify/checks.py", "simulate/simulate.py", "laws/local.py", "gains/design.py"} <= names


def test_one_number_changed_breaks_the_seal() -> None:
    text = table1_set().to_yaml()
    line = next(line for line in text.splitlines() if "overlap_to_rad_s" in line)
    meddled = parse_gains(text.replace(line, line.replace("0.02", "0.021")), "set")
    assert meddled.seal_broken
    assert not next(check_seal(subject(meddled))).passed
    assert not verify(meddled, plants=1, processes=1).valid


@pytest.mark.parametrize(
    ("path", "factor"),
    [
        (("parameters", "regions", "low", "k_x_per_rad"), 1.01),
        (("design", "regions", 0, "vertices", 2, "a", 1, 1), 1.01),
        (("design", "regions", 1, "feedback", 0), 0.5),
        (("design", "regions", 1, "vertices", 0, "lyapunov_disc", 0, 0), 0.5),
        (("design", "model", "inertia"), 1.01),
        (("design", "uncertainty", "slope"), 1.5),
    ],
)
def test_the_proof_sees_a_change_that_was_sealed_again(path: tuple[Any, ...], factor: float) -> None:
    assert not all(check.passed for check in check_regions(subject(changed(path, factor))))


def test_the_loop_check_sees_what_the_regions_cannot() -> None:
    unstable = changed(("parameters", "disturbance_observer", "bandwidth_rad_s"), 12.0)
    assert not all(check.passed for check in check_loop(subject(unstable)))


def test_a_pole_on_the_circle_is_not_inside_and_constant_states_are_named() -> None:
    s = subject(table1_set())
    s.__dict__["dense"] = s.coarse.at(s.coarse.speeds[:2])
    checks = list(check_loop(s))
    poles = [check for check in checks if "largest pole" in check.name]
    assert poles and all(check.limit < 1.0 for check in poles)
    assert "d_hat" in checks[0].name and "z_hat" in checks[0].name and checks[0].passed


def test_a_set_without_design_cannot_be_verified() -> None:
    with pytest.raises(BadInput, match="design"):
        verify(load_gains(MODEL.parents[1] / "demo_local.yaml"))


def test_the_same_seed_draws_the_same_plants_over_any_number_of_processes() -> None:
    alone, shared = (monte_carlo(table1_set(), 4, 7, processes) for processes in (1, 2))
    assert alone == shared
    assert np.ptp([trial.error_share for trial in alone]) > 0.0


def test_no_solver_is_imported() -> None:
    code = "import sys, servod.lab.verify.certify; print(' '.join(m.split('.')[0] for m in sys.modules))"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not {"cvxpy", "clarabel", "scs"} & set(result.stdout.split())
    assert "servod.lab.synthesize" not in result.stdout
