"""The compiled kernels give what the plain ones give: what the simulator runs is what the loop runs."""

from __future__ import annotations

import math
from dataclasses import astuple

import pytest

from servod.kernels.laws import LAWS
from servod.kernels.laws.position import PositionTorques
from servod.kernels.laws.state import STATES, LawState
from servod.kernels.laws.weights import Shape
from servod.kernels.physics.compiled import arrays, compiled, record
from servod.kernels.physics.layout import PlantParameters, PlantRecord, PlantState
from tests.kernels.laws.cases import GAINS, PARAMETERS, local_parameters

CASES = {
    **PARAMETERS,
    "local memory": local_parameters(memory=(0.4, 0.3, 0.1)),
    **{f"local {shape.name}": local_parameters(gain=0.04, shape=float(shape)) for shape in Shape},
}


@pytest.mark.parametrize("case", list(CASES))
def test_compiled_equals_plain(case: str) -> None:
    law = LAWS[case.split(maxsplit=1)[0]]
    kernel, p = compiled(law.step), law.named(CASES[case])
    plain_state, (state, memory) = LawState(), record(LawState())
    for k in range(400):
        t = k * 0.01
        v = 0.7 * math.sin(3.0 * t) ** 3
        arguments = (math.sin(t), math.cos(t), -math.sin(t), math.sin(t) - 1e-3 * math.cos(9 * t), v)
        plain = law.step(p, plain_state, *arguments, plain_state.asked, 0.001)
        assert kernel(arrays(p), memory[0], *arguments, state.asked, 0.001) == pytest.approx(plain, rel=1e-9, abs=1e-13)
    assert memory.tolist()[0] == pytest.approx(astuple(plain_state), rel=1e-9, abs=1e-13)


def test_nan_comes_through_the_compiled_kernels_too() -> None:
    for name, p in GAINS.items():
        torque = compiled(LAWS[name].step)(
            arrays(p), record(LawState()).memory[0], 0.0, 0.0, 0.0, 0.0, math.nan, 0.0, 0.001
        )[0]
        assert math.isnan(torque)


def test_a_record_is_one_memory_seen_from_both_sides() -> None:
    names, memory = record(LawState(z_hat=0.25, rest=1.0))
    assert memory.dtype.names == STATES
    names.d_hat = 0.5
    memory["asked"] = 0.125
    assert (memory["z_hat"][0], memory["d_hat"][0], names.asked, names.rest) == (0.25, 0.5, 0.125, 1.0)


def test_parameters_and_state_of_a_plant_are_one_record() -> None:
    """What numba takes for each array at a call is most of what a short call takes."""
    names, memory = record(PlantRecord(PlantParameters(inertia=0.5, cogging_n=3), PlantState(velocity=0.25, head=7)))
    assert (names.p.inertia, names.p.cogging_n, names.s.velocity, names.s.head) == (0.5, 3, 0.25, 7)
    state = names.s
    memory["s"]["bristle"] = 1e-4
    state.friction = 0.125
    assert (state.bristle, memory["s"]["friction"][0], memory.shape) == (1e-4, 0.125, (1,))


def test_records_of_a_kind_share_their_dtype() -> None:
    """At every call numba compares the dtypes of records unless they are one object."""
    assert record(LawState()).memory.dtype is record(LawState(z_hat=1.0)).memory.dtype


def test_position_goes_flat_and_back() -> None:
    p = GAINS["local"]._replace(knows_position=True, position=PositionTorques(lead=0.001, waves=(0.1, 36.0, 0.2)))
    assert LAWS["local"].accepts(p.flat())
    assert LAWS["local"].named(p.flat()) == p
