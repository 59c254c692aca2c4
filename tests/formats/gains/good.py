"""A good gain set as text, and one with a certificate, for the tests of gain sets and store."""

from __future__ import annotations

import datetime

from servod.common.shipped import shipped
from servod.formats.gains.design import Design, DesignMode, Uncertainty
from servod.formats.gains.gain_set import Certificate, CertificateCheck, GainSet, parse_gains
from servod.formats.model.axis_model import load_axis_model

PD = """\
schema_version: 1
name: bench_pd
description: for tests
parameters:
  law: pd
  position_gain_nm_per_rad: 2.5
  velocity_gain_nms_per_rad: 12e-2
provenance:
  author: A. Engineer
  date: 2026-11-20
"""

LUGRE = """\
schema_version: 1
name: bench_lugre
parameters:
  law: pd_lugre
  position_gain_nm_per_rad: 2.5
  velocity_gain_nms_per_rad: 0.12
  stiffness_nm_per_rad: 950
  damping_nms_per_rad: 1.0
  viscous_nms_per_rad: 0.056
  coulomb_nm: 0.045
  static_nm: 0.07
  stribeck_velocity_rad_s: 0.1
  friction_limit_nm: 0.1
provenance: {author: A. Engineer, date: 2026-11-20}
"""

LOCAL = """\
schema_version: 1
name: bench_local
parameters:
  law: local
  regions:
    low: {k_x_per_rad: 1574.9, k_v_s_per_rad: 0.241}
    high: {k_x_per_rad: 197, k_v_s_per_rad: 2.104}
    overlap_from_rad_s: 0.005
    overlap_to_rad_s: 0.02
  friction:
    stiffness_nm_per_rad: 760.0
    viscous_nms_per_rad: 0.056
    friction_limit_nm: 0.12
    sets:
      - {velocity_rad_s: -0.5, decay_per_s: 8000.0, gain: 0.04}
      - {velocity_rad_s: 0.0, decay_per_s: 0.0}
      - {velocity_rad_s: 0.5, decay_per_s: 7000.0}
provenance: {author: A. Engineer, date: 2026-11-20}
"""


#: A design without proofs, which nothing but the loop's facts are read from.
DESIGN = Design(
    mode=DesignMode.DEPLOYED,
    period_s=0.001,
    velocity_cutoff_hz=120.0,
    counts_per_turn=2.0**20,
    speed_max_rad_s=0.5,
    model=load_axis_model(shipped("gains/axes/table1_joint.yaml")),
    uncertainty=Uncertainty(),
)


def certified(gains: GainSet, valid: bool = True) -> GainSet:
    """`gains` with a certificate for exactly these parameters, with a design, sealed."""
    certificate = Certificate(
        valid=valid,
        parameters_sha256=gains.parameters_sha256(),
        issued_by="verify 1.0",
        issued_at=datetime.datetime(2026, 11, 20, 12, 0, tzinfo=datetime.UTC),
        checks=[CertificateCheck(name="spectral radius", value=0.97, limit=1.0, margin=0.03, passed=True)],
    )
    parts = {"certificate": certificate, "design": gains.design or DESIGN}
    return parse_gains(gains.model_copy(update=parts).sealed().to_yaml(), "certified.yaml")


def certified_text() -> str:
    """The text of a certified PD set."""
    return certified(parse_gains(PD, "good.yaml")).to_yaml()
