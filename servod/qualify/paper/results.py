"""Everything that a run of `paper` found, and the rows of its comparison.

Between the walk, which fills it, and the figures, which read it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

from servod.lab.report.figures.motion import PlottedMotion
from servod.qualify.paper.equations import TwoForms
from servod.qualify.paper.experiments import Contender, Found, Measured
from servod.qualify.paper.joints import PaperJoint
from servod.qualify.paper.printed import RMS_MRAD
from servod.qualify.paper.programme import ProgrammeAnswer
from servod.qualify.paper.sweeps import SweepOfL


class Row(Enum):
    """A controller of the comparison: what people read, and the RMS error that the paper prints for it, in mrad."""

    PD = "PD", None
    DOB = "PD + DOB, 50 rad/s", RMS_MRAD["pd_dob"]
    LUGRE = "PD + LuGre, l_f 0", RMS_MRAD["pd_lugre"]
    LUGRE_BETTER = "PD + LuGre, l_f 0.25", RMS_MRAD["pd_lugre"]
    LUGRE_OSCILLATES = "PD + LuGre, l_f 0.35", RMS_MRAD["pd_lugre"]
    TABLE1 = "Table I as (K_z, K_v, K_x)", RMS_MRAD["local"]
    TABLE1_OTHER = "Table I as (K_x, K_v, K_z)", RMS_MRAD["local"]
    TABLE1_PRINTED_L = "Table I, l_i as printed", RMS_MRAD["local"]
    LOCAL_PLAIN = "local at the paper's PD gains, no observer, measured velocity", RMS_MRAD["local"]
    LOCAL_EQUAL = "local at the paper's PD gains, observer, corrected reference velocity", RMS_MRAD["local"]
    DEPLOYED = "local, synthesized", RMS_MRAD["local"]

    def __init__(self, label: str, paper_mrad: float | None) -> None:
        self.label = label
        self.paper_mrad = paper_mrad


@dataclass(frozen=True)
class Results:
    """One run. `sines` are the motions of Fig. 9 to 12; `noise` is the RMS over NOISE_SHARES by controller."""

    seed: int
    seconds: float
    found: dict[PaperJoint, Found]
    measured: dict[tuple[PaperJoint, Row], Measured]
    sines: dict[str, PlottedMotion]
    sweeps: dict[str, SweepOfL]
    noise: dict[str, list[float]]
    slips: dict[str, TwoForms]
    programme: list[ProgrammeAnswer]
    tuned: dict[PaperJoint, list[Contender]] = field(default_factory=dict)

    def rms(self, joint: PaperJoint, row: Row) -> float | None:
        """RMS error of (19) in mrad; None where the axis stopped."""
        tracking = self.measured[joint, row].tracking()
        return None if tracking is None else tracking.rms_error_mrad
