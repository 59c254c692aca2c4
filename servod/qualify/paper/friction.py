"""Fig. 2, 7 and 8: weighting functions, Dahl curve, friction-velocity map, and what the paper says of them.

Stands on the identification of the virtual axes.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from servod.formats.gains.gain_set import GainSet
from servod.lab.report.figure import array
from servod.lab.report.figures.friction import dahl_curve, friction_map
from servod.lab.report.figures.sets import (
    local_friction,
    local_law,
    steady_compensation,
    weight_table,
    weighting_functions,
)
from servod.lab.verify.steady_friction import steady_friction
from servod.qualify.paper.claims import Claim, Shown
from servod.qualify.paper.experiments import Found
from servod.qualify.paper.joints import PaperJoint, shipped_set
from servod.qualify.paper.printed import FRICTION, NODES_RAD_S
from servod.qualify.paper.results import Results

#: "Very low velocities" of the paper's partition, and the slowest speed at which its map can be judged [rad/s].
VERY_LOW, SLOWEST = 0.01, 0.005
#: A map agrees with (18) within this share.
MAP_SHARE = 0.05
_SPEEDS = np.geomspace(SLOWEST, 0.5, 60)


def figures(results: Results) -> Iterator[Shown]:
    """Weights first, as in the paper; Dahl curve and map only of joints that were identified."""
    table1, deployed = shipped_set("table1_kz_kv_kx"), results.found[PaperJoint.TABLE1].gains
    yield Shown("2", weighting_functions(table1, "figure_02_weighting_functions"), (_unity(table1), _density(deployed)))
    friction = local_friction(table1, PaperJoint.TABLE1.model(), "figure_02_friction_of_nine_sets")
    yield Shown("2", friction, (_nine_sets(table1),))
    placed = local_friction(deployed, name="figure_02_friction_of_placed_sets")
    yield Shown("2", placed, (_placed_sets(deployed),))
    for joint, found in results.found.items():
        if found.presliding is None:
            continue
        dahl = dahl_curve(found.presliding, joint.model(), f"figure_07_dahl_{joint.value}")
        yield Shown("7", dahl, (_stiffness(found, joint),), joint.label)
        drawn = friction_map(found.model, joint.model(), f"figure_08_map_{joint.value}")
        yield Shown("8", drawn, (_map_error(found, joint), _asymmetry(found, joint)), joint.label)


def _unity(gains: GainSet) -> Claim:
    velocity = np.linspace(-0.6, 0.6, 2001)
    off = float(np.abs(weight_table(local_law(gains), velocity).sum(axis=1) - 1.0).max())
    return Claim(
        "the weights blend the local sets smoothly", f"they sum to one within {off:.1g} everywhere", off < 1e-9
    )


def _density(gains: GainSet) -> Claim:
    nodes = [s.velocity_rad_s for s in local_law(gains).friction.sets]
    low, printed = sum(abs(v) <= VERY_LOW for v in nodes), sum(abs(v) <= VERY_LOW for v in NODES_RAD_S)
    here = (
        f"sets placed by the force between them have {low} of {len(nodes)} within {VERY_LOW:g} rad/s of zero, Table I "
        f"has {printed} of {len(NODES_RAD_S)}"
    )
    return Claim("most sets are needed at very low velocities", here, low > len(nodes) / 2)


def _worst_share(gains: GainSet) -> tuple[float, float]:
    """(largest relative error of the sets' steady friction against Table I's joint, velocity of it)."""
    friction = steady_friction(PaperJoint.TABLE1.model())
    velocity = np.concatenate([-_SPEEDS[::-1], _SPEEDS])
    truth = array([friction.torque(float(v)) for v in velocity])
    share = np.abs(steady_compensation(local_law(gains), velocity) / truth - 1.0)
    return float(share.max()), float(velocity[share.argmax()])


def _nine_sets(gains: GainSet) -> Claim:
    worst, where = _worst_share(gains)
    here = f"the friction between the nine sets is off by up to {worst:.0%}, at {where:.3g} rad/s"
    return Claim("the nine sets of Table I describe the friction", here, worst <= MAP_SHARE)


def _placed_sets(gains: GainSet) -> Claim:
    worst, where = _worst_share(gains)
    count = len(local_law(gains).friction.sets)
    here = f"{count} sets placed on the map are off by up to {worst:.1%} of the plant's friction, at {where:.3g} rad/s"
    return Claim("local sets can describe the friction of the whole range", here, worst <= MAP_SHARE)


def _stiffness(found: Found, joint: PaperJoint) -> Claim:
    assert found.presliding is not None
    c0 = found.presliding.stiffness
    here = f"{joint.label} gives {c0.value:.0f} N·m/rad (95 %: {c0.low:.0f} to {c0.high:.0f})"
    paper = f"the Dahl curve gives c0, σ0 = {FRICTION.sigma0:g} N·m/rad in Table I"
    return Claim(paper, here, c0.holds(FRICTION.sigma0))


def _map_error(found: Found, joint: PaperJoint) -> Claim:
    assert found.model.identified is not None
    nodes = found.model.identified.friction_map
    truth = steady_friction(joint.model())
    pairs = [(v, t / truth.torque(v) - 1.0) for v, t in zip(nodes.velocities, nodes.torques, strict=True)]
    where, worst = max(((v, e) for v, e in pairs if abs(v) >= SLOWEST), key=lambda pair: abs(pair[1]))
    here = (
        f"on {joint.label} it is within {abs(worst):.1%} of the plant from {SLOWEST:g} rad/s up (at {where:.3g} rad/s)"
    )
    return Claim("slow sines under PD give the friction-velocity map", here, abs(worst) <= MAP_SHARE)


def _asymmetry(found: Found, joint: PaperJoint) -> Claim:
    """Judged at the speed where both directions differ most against their intervals."""
    assert found.model.identified is not None
    nodes = found.model.identified.friction_map
    v, torque, half = array(nodes.velocities), array(nodes.torques), array(nodes.half_widths)
    plus, minus = v > 0.0, v < 0.0
    other = np.interp(v[plus], -v[minus][::-1], -torque[minus][::-1])
    other_half = np.interp(v[plus], -v[minus][::-1], half[minus][::-1])
    lean = (torque[plus] - other) / (0.5 * (torque[plus] + other))
    seen = np.abs(torque[plus] - other) > half[plus] + other_half
    here = (
        f"the directions of {joint.label} differ by {float(np.mean(lean)):+.1%} of their mean, beyond both intervals "
        f"at {np.mean(seen):.0%} of the nodes"
    )
    return Claim("friction differs between the directions", here, bool(np.mean(seen) > 0.5))
