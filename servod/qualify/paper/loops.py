"""Fig. 4 and 6: the axis before and after compensation, impulse responses at every vertex, and what the paper says.

Stands on the design of the deployed gain set; no solver.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from servod.formats.gains.design import Design, RegionProof
from servod.formats.gains.gain_set import GainSet
from servod.lab.report.figures.loop import HIGH_VELOCITIES, LOW_VELOCITIES, bode, design_of, impulse_responses
from servod.lab.report.figures.sets import local_law
from servod.lab.report.responses import Loop, before, closed_loop_response, frequency_response, rigid, vertex_impulse
from servod.lab.verify.closed_loop import spectral_radius
from servod.qualify.paper.claims import Claim, Shown
from servod.qualify.paper.joints import PaperJoint
from servod.qualify.paper.results import Results

#: Where the axis is compared with a rigid joint [Hz]: what a position loop uses.
BAND_HZ = np.geomspace(1.0, 100.0, 60)
FLAT_HZ = np.geomspace(0.5, 10.0, 40)
FLAT_DB = 6.0
_SAMPLES = 2000


def figures(results: Results) -> Iterator[Shown]:
    """Both figures of Table I's joint, as it was identified."""
    gains = results.found[PaperJoint.TABLE1].gains
    design = design_of(gains)
    claims = (_nearer(gains, LOW_VELOCITIES, "very low"), _nearer(gains, HIGH_VELOCITIES, "higher"), _flat(gains))
    yield Shown("4", bode(gains, name="figure_04_bode"), claims)
    drawn = impulse_responses(gains, "figure_06_impulse_responses")
    yield Shown("6", drawn, tuple(_fades(region, design) for region in design.regions))


def _nearer(gains: GainSet, velocities: Sequence[float], what: str) -> Claim:
    """Mean distance in dB of position over torque from the rigid joint's, before and after."""
    design, law = design_of(gains), local_law(gains)
    with_observer = law.disturbance_observer is not None
    clauses, better = [], []
    for v in velocities:
        alone = _distance_db(design, before(design, v))
        plain, whole = closed_loop_response(design, law, v, False), closed_loop_response(design, law, v, with_observer)
        text = f"at {v:g} rad/s {alone:.1f} dB before, {_distance_db(design, plain):.1f} after (9)"
        if with_observer:
            text += f", {_distance_db(design, whole):.1f} with the output observer"
        unstable = [
            name
            for name, loop in (("(9)", plain), ("the observer", whole))
            if spectral_radius(loop[0][None])[0] > 1 + 1e-6
        ]
        clauses.append(text + (f" (without feedback unstable with {' and '.join(unstable)})" if unstable else ""))
        better.append(_distance_db(design, plain) < alone)
    paper = f"compensation improves the local dynamics at {what} velocities"
    return Claim(paper, "the distance from a rigid joint, 1 to 100 Hz, is " + "; ".join(clauses), all(better))


def _distance_db(design: Design, loop: Loop) -> float:
    seen = np.abs(frequency_response(*loop, design.period_s, BAND_HZ))
    return float(np.mean(np.abs(20.0 * np.log10(seen / np.abs(rigid(design, BAND_HZ))))))


def _flat(gains: GainSet) -> Claim:
    """At rest the axis is a spring before and after: its response over the low frequencies."""
    design, law = design_of(gains), local_law(gains)
    loop = closed_loop_response(design, law, 0.0, False)
    seen = 20.0 * np.log10(np.abs(frequency_response(*loop, design.period_s, FLAT_HZ)))
    spread = float(np.ptp(seen))
    here = (
        f"it varies by {spread:.1f} dB from {FLAT_HZ[0]:g} to {FLAT_HZ[-1]:g} Hz, the leak of the friction state in it"
    )
    return Claim("at rest the compensated response is flat at low frequencies", here, spread <= FLAT_DB)


def _fades(region: RegionProof, design: Design) -> Claim:
    """Every response comes down, and its norm keeps to the bound that the LMIs promise."""
    faded, ratios = [], []
    for vertex in region.vertices:
        response = vertex_impulse(region, vertex, _SAMPLES)
        alive = np.flatnonzero(np.abs(response[:, 0]) > 0.02 * np.abs(response[:, 0]).max())
        faded.append(design.period_s * float(alive[-1] + 1))
        if vertex.output is not None:
            ratios.append(float(np.sqrt(np.sum(response**2) / np.trace(np.array(vertex.output)))))
    here = (
        f"region {region.name}: all {len(region.vertices)} fade to 2 % within {1e3 * max(faded):.0f} ms, their norms "
        f"are at most {max(ratios):.2f} of what is proven"
    )
    bounded = max(ratios) <= 1.0 and max(faded) < design.period_s * _SAMPLES
    return Claim("all responses lie within what the design guarantees", here, bounded)
