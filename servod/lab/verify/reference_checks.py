"""Checks of a set's proofs that hold for both modes: that every region has one, and the paper's own inequalities.

Stands beside `checks`. What the reference mode proves says nothing of the sampled loop; the other checks judge that.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from servod.formats.gains.gain_set import CertificateCheck
from servod.formats.gains.parameters import LocalParameters
from servod.lab.verify.checks import SAME, Subject, at_least, at_most
from servod.lab.verify.reference_proof import gain_numbers, reference_margin, stored_polytope_deviation

REGIONS = 2


def check_reference(s: Subject) -> Iterator[CertificateCheck]:
    """A proof for each region; (14) by eigenvalues; its polytope as model and law say; the law's gains as proven."""
    proofs = s.design.reference
    proven = {proof.name for proof in s.design.regions} | {proof.name for proof in proofs}
    yield at_least("regions with a proof", float(len(proven & {"low", "high"})), REGIONS)
    local = s.gains.parameters
    for proof in proofs:
        yield at_least(
            f"(14) of region {proof.name}, least relative eigenvalue", reference_margin(s.design, proof), 0.0
        )
        if isinstance(local, LocalParameters):
            away = stored_polytope_deviation(s.design, local.friction, proof)
            yield at_most(f"polytope of region {proof.name} against model and law", away, SAME)
            own = getattr(local.regions, proof.name)
            used = (own.k_z_per_rad, own.k_x_per_rad, own.k_v_s_per_rad)
            pairs = list(zip(used, gain_numbers(proof), strict=True))
            worst = float(np.max([abs(x - y) / max(abs(x), abs(y), 1e-12) for x, y in pairs]))
            away = worst + sum(map(abs, own.pack_memory()))
            yield at_most(f"gains of region {proof.name} against the proven ones", away, SAME)
