"""The deployed mode: what it reaches on Table I's joint, what it proves, and what it says when it cannot."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from servod.formats.gains.design import Uncertainty
from servod.formats.gains.gain_set import GainSet, parse_gains
from servod.formats.gains.parameters import LocalParameters
from servod.formats.model.axis_model import LugreFriction
from servod.kernels.motions import paper
from servod.lab.simulate.simulate import LoopSettings, simulate_closed_loop
from servod.lab.synthesize import deployed, infeasible
from servod.lab.synthesize.deployed import Wishes
from servod.lab.synthesize.gain_set import synthesize, with_feedback
from servod.lab.synthesize.regions import pole_disc
from servod.lab.verify.checks import speeds_of
from servod.lab.verify.margins import Sweep
from servod.lab.verify.proof import closed, region_margin
from servod.lab.verify.sampled import SampledTiming
from servod.lab.verify.steady_friction import steady_friction
from tests.lab.synthesize.designs import table1, table1_set


def test_a_set_comes_out_sealed_and_reads_back_equal() -> None:
    gains = table1_set()
    again = parse_gains(gains.to_yaml(), "set")
    assert again == gains and not again.seal_broken
    assert gains.certificate_problem() == "no certificate"


@pytest.mark.parametrize("index", [0, 1])
def test_every_vertex_keeps_its_disc(index: int) -> None:
    design = table1_set().design
    assert design is not None
    region = design.regions[index]
    assert region_margin(region)[0] > 0.0
    for vertex in region.vertices:
        poles = np.linalg.eigvals(closed(region, vertex)[0])
        assert np.abs(poles - vertex.disc_centre).max() < vertex.disc_radius


def test_both_regions_are_stiffer_than_the_papers_pd() -> None:
    law = table1_set().parameters
    assert isinstance(law, LocalParameters)
    assert law.input_scale_nm * law.regions.low.k_x_per_rad > 10.0
    assert law.input_scale_nm * law.regions.high.k_x_per_rad > 5.0


def test_the_deployed_law_tracks_the_papers_trajectory() -> None:
    gains = table1_set()
    assert gains.design is not None
    motion = np.array([paper(k * 1e-3) for k in range(12_000)])
    settings = LoopSettings(velocity_cutoff_hz=gains.design.velocity_cutoff_hz)
    run = simulate_closed_loop(table1(), gains.law, gains.pack(), motion, settings)
    assert np.sqrt(np.mean(run.tracking_error_rad(1.0) ** 2)) < 0.03e-3


def test_at_the_papers_pd_gains_the_compensation_alone_tracks_within_a_fifth_of_a_milliradian() -> None:
    equal = with_feedback(table1_set(), "equal", 2.5, 0.12)
    motion = np.array([paper(k * 1e-3) for k in range(12_000)])
    run = simulate_closed_loop(table1(), equal.law, equal.pack(), motion)
    assert np.sqrt(np.mean(run.tracking_error_rad(1.0) ** 2)) < 0.2e-3
    assert equal.certificate_problem() == "no certificate" and not equal.seal_broken


@pytest.mark.parametrize("amplitude_rad", [0.1, 0.01])
def test_a_step_settles_without_overshoot(amplitude_rad: float) -> None:
    gains = table1_set()
    assert gains.design is not None
    motion = np.zeros((1000, 3))
    motion[:, 0] = amplitude_rad
    settings = LoopSettings(velocity_cutoff_hz=gains.design.velocity_cutoff_hz, torque_limit_nm=0.5)
    run = simulate_closed_loop(table1(), gains.law, gains.pack(), motion, settings, start=(0.0, 0.0, 0.0))
    assert run.position_rad.max() < 1.03 * amplitude_rad
    assert np.abs(run.position_rad[150:] - amplitude_rad).max() < 0.02 * amplitude_rad


def test_what_cannot_be_is_refused_with_the_vertices_that_clash() -> None:
    wishes = Wishes(uncertainty=Uncertainty(slope=0.8, dry=0.6), cutoff_hz=120.0, slow_disc=0.998)
    assert deployed.regions(table1(), wishes) is None
    design = deployed.empty_design(table1(), wishes, 120.0)
    clashes = list(infeasible.clashing_vertices(design, wishes.spans[1], wishes))
    assert any("falling" in line for line in clashes)


def test_the_relaxation_that_is_offered_is_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(infeasible, "RELAX_STEPS", 2)
    wishes = Wishes(uncertainty=Uncertainty(slope=0.8, dry=0.6), cutoff_hz=300.0, slow_disc=0.998)
    offered = next(iter(infeasible.relaxations(table1(), wishes)))
    assert offered.wish == "scale of the uncertainty" and 0.0 < offered.enough < 1.0
    taken = replace(wishes, uncertainty=wishes.uncertainty.scaled(offered.enough))
    assert deployed.regions(table1(), taken) is not None


@pytest.mark.parametrize(("decay", "damping"), [(5.0, 0.05), (20.0, 0.1), (50.0, 0.3)])
def test_the_disc_lies_inside_decay_and_damping(decay: float, damping: float) -> None:
    centre, radius = pole_disc(decay, damping, 0.001)
    z = centre + radius * np.exp(1j * np.linspace(0.0, 2.0 * np.pi, 400))
    s = np.log(z) / 0.001
    assert (s.real <= -decay + 1e-6).all()
    assert (-s.real / np.abs(s) >= damping - 1e-3).all()


def test_feeding_the_last_commands_back_is_worth_disk_margin() -> None:
    gains = table1_set()
    law = gains.parameters
    assert isinstance(law, LocalParameters) and gains.design is not None
    low, high = law.regions.low, law.regions.high
    assert low.k_u and high.k_u
    plain = {
        name: region.model_copy(
            update={
                "k_x_per_rad": region.k_x_per_rad / (1.0 + sum(region.k_u or [])),
                "k_v_s_per_rad": region.k_v_s_per_rad / (1.0 + sum(region.k_u or [])),
                "k_u": None,
            }
        )
        for name, region in (("low", low), ("high", high))
    }
    without = law.model_copy(update={"regions": law.regions.model_copy(update=plain)})
    timing = SampledTiming(gains.design.period_s, gains.design.model.total_delay_s, gains.design.velocity_cutoff_hz)
    margins = [
        Sweep(gains.law, p.pack(), steady_friction(table1()), timing, speeds_of(gains.design, 16)).disk_margin()[0]
        for p in (law, without)
    ]
    assert margins[0] > 1.2 * margins[1]


@pytest.mark.parametrize("factor", [0.8, 1.0, 1.2])
def test_friction_that_changes_after_the_design_hardly_shows(factor: float) -> None:
    gains, joint = table1_set(), table1()
    assert gains.design is not None and isinstance(joint.friction, LugreFriction)
    f = joint.friction
    assert f.static is not None
    update = {"coulomb": f.coulomb * factor, "static": f.static * factor, "viscous": f.viscous * factor}
    motion = np.array([paper(k * 1e-3) for k in range(12_000)])
    settings = LoopSettings(velocity_cutoff_hz=gains.design.velocity_cutoff_hz)
    changed = joint.model_copy(update={"friction": f.model_copy(update=update)})
    run = simulate_closed_loop(changed, gains.law, gains.pack(), motion, settings)
    assert np.sqrt(np.mean(run.tracking_error_rad(1.0) ** 2)) < 0.025e-3


@pytest.mark.parametrize("amplitude_rad", [0.1, -0.01])
def test_a_step_comes_to_rest_within_two_hundredths_of_a_milliradian(amplitude_rad: float) -> None:
    gains = table1_set()
    assert gains.design is not None
    motion = np.zeros((8000, 3))
    motion[:, 0] = amplitude_rad
    settings = LoopSettings(velocity_cutoff_hz=gains.design.velocity_cutoff_hz, torque_limit_nm=0.3)
    run = simulate_closed_loop(table1(), gains.law, gains.pack(), motion, settings, start=(0.0, 0.0, 0.0))
    assert np.ptp(run.position_rad[1000:]) < 2e-5
    assert np.abs(run.true_velocity_rad_s).max() < 2.0


def test_with_two_cycles_of_delay_there_is_still_a_design() -> None:
    slow = table1().model_copy(update={"delay_s": 0.002})
    gains = synthesize(slow)
    assert isinstance(gains, GainSet) and isinstance(gains.parameters, LocalParameters)
    assert gains.parameters.disturbance_observer is not None
    assert len(gains.parameters.regions.high.k_u or []) == 3
