"""The paper's programme (12)-(15), printed and consistent, and what its answer does on the sampled axis.

A job of the pool; stands on the reference mode of synthesis. The programme knows no sample time: whether its feedback
stands one is judged by the full sampled loop and by a simulated run.
"""

from __future__ import annotations

from dataclasses import dataclass

from servod.formats.gains.design import ReferenceForm
from servod.kernels.laws import LAWS
from servod.lab.synthesize.deployed import Wishes
from servod.lab.synthesize.gain_set import DesignOptions
from servod.lab.synthesize.lmi_reference import ReferenceWishes
from servod.lab.synthesize.reference import ReferenceFrame, frame
from servod.lab.verify.checks import CORNER_SPEEDS, speeds_of
from servod.lab.verify.margins import NOMINAL, Sweep
from servod.lab.verify.reference_proof import gain_numbers, reference_gains
from servod.lab.verify.sampled import SampledTiming
from servod.qualify.paper.joints import PaperJoint, shipped_set, with_law
from servod.qualify.paper.sweeps import rms_mrad

#: Both ends of a useful l, in rad/s per unit of u*.
GAINS_L = (0.0, 0.04)


@dataclass(frozen=True)
class RegionAnswer:
    """Feedback of one region in N*m/rad and N*m*s/rad of position and velocity; else why there is none."""

    position_nm_per_rad: float | None
    velocity_nms_per_rad: float | None
    clashes: tuple[str, ...]


@dataclass(frozen=True)
class ProgrammeAnswer:
    """One form with one l: both regions; the sampled loop's largest pole and (19) where both have a feedback."""

    form: str
    l_i: float
    regions: dict[str, RegionAnswer]
    largest_pole: float | None
    rms_mrad: float | None


def answers(seconds: float) -> list[ProgrammeAnswer]:
    """Both forms with each l, for Table I's joint with the default intervals."""
    return [answer(form, l_i, seconds) for form in ReferenceForm for l_i in GAINS_L]


def answer(form: ReferenceForm, l_i: float, seconds: float) -> ProgrammeAnswer:
    """Solve both regions, and run what comes out."""
    model = PaperJoint.TABLE1.model()
    made = frame(model, Wishes(), DesignOptions(gain=l_i, observer=False), ReferenceWishes(form=form))
    found = {span.name: made.answer(span) for span in made.spans}
    scale, regions, gains = made.law.input_scale_nm, {}, {}
    for name, region in found.items():
        if region.proof is None:
            regions[name] = RegionAnswer(None, None, region.clashes)
            continue
        _, position, speed = gain_numbers(region.proof)
        regions[name] = RegionAnswer(scale * position, scale * speed, ())
        gains[name] = reference_gains(region.proof)
    if len(gains) < len(found):
        return ProgrammeAnswer(form.value, l_i, regions, None, None)
    law = made.law.model_copy(update={"regions": made.law.regions.model_copy(update=gains)})
    gain_set = with_law(shipped_set("table1_kz_kv_kx"), "programme", law)
    return ProgrammeAnswer(
        form.value, l_i, regions, _largest_pole(made, gain_set.pack()), rms_mrad(model, gain_set, seconds)
    )


def _largest_pole(made: ReferenceFrame, packed: tuple[float, ...]) -> float:
    """Of the nominal sampled loop over all velocities, with its delay and velocity filter."""
    d = made.design
    timing = SampledTiming(d.period_s, d.model.total_delay_s, d.velocity_cutoff_hz)
    return Sweep(LAWS["local"], packed, made.friction, timing, speeds_of(d, CORNER_SPEEDS)).worst(NOMINAL).radius
