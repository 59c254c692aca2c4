"""Friction that falls steeply: feedback with the H2 norm at every vertex, and with the bristle's turn in view."""

from __future__ import annotations

from dataclasses import replace

from servod.formats.model.axis_model import LugreFriction
from servod.formats.model.friction import Stribeck
from servod.lab.synthesize.deployed import Wishes, bare_proof, empty_design, programme, proven
from servod.lab.synthesize.lmi_deployed import largest_pole, shaped, turned
from servod.lab.verify.proof import region_margin, stored_deviation
from tests.lab.synthesize.designs import table1

CUTOFF_HZ = 800.0


def test_feedback_comes_to_hold_a_turned_bristle_which_is_no_part_of_the_proof() -> None:
    friction = table1().friction
    assert isinstance(friction, LugreFriction)
    model = table1().model_copy(
        update={
            "friction": friction.model_copy(update={"stribeck_velocity": 0.06}),
            "stribeck": Stribeck(exponent=2.5),
            "inertia": 0.9 * table1().inertia,
        }
    )
    wishes = next(iter(Wishes(cutoff_hz=CUTOFF_HZ, slow_disc=0.998).steadier()))
    design = empty_design(model, wishes, CUTOFF_HZ)
    frame = bare_proof(design, wishes.spans[1], wishes)
    p = programme(design, frame, wishes)
    turning = p.only("turning")

    before = shaped(p.only("sliding"))
    assert before is not None
    reach = largest_pole(turning, before.feedback)
    wanted = turning.turning_within(reach - 0.01)
    found = turned(replace(p, discs=p.turning_within(reach - 0.01).discs), before)
    assert found is not None
    assert largest_pole(wanted, found.feedback) <= reach - 0.01 + 1e-6

    proof = proven(design, frame, p, found)
    assert set(proof.slack) == {"sliding"} == {vertex.mode for vertex in proof.vertices}
    assert all(vertex.lyapunov_h2 is not None for vertex in proof.vertices)
    assert region_margin(proof)[0] > 0.0
    assert stored_deviation(design, proof) == 0.0
