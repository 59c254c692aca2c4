"""The engine: bumpless change between every pair of laws, states carried over, bad parameters refused."""

from __future__ import annotations

import inspect
import itertools
import math
from dataclasses import astuple, replace
from typing import Any

import pytest

from servod.common.shipped import shipped
from servod.formats.gains.gain_set import load_gains
from servod.kernels.laws import LAW_BY_NUMBER, LAWS, MAX_PARAMETERS, MAX_SETS, LawNumber, in_slots, local
from servod.kernels.laws.position import PositionTorques
from servod.kernels.laws.state import LawState
from servod.runtime.loop.controller import BUMPLESS_TIME_S, Controller
from tests.kernels.laws.cases import GAINS, PARAMETERS, SIGMA0, local_gains, local_parameters

DT = 0.001


def running(name: str) -> tuple[Controller, float]:
    """A controller that has run for a while with motion and error, and its last torque."""
    controller = Controller()
    assert controller.activate(LAWS[name].number, PARAMETERS[name], 0.0)
    torque = 0.0
    for k in range(300):
        torque = controller.step(1e-4 * k, 0.1, 0.0, 1e-4 * k - 2e-3, 0.09, torque, DT).u
    return controller, torque


@pytest.mark.parametrize(("old", "new"), list(itertools.product(LAWS, repeat=2)))
def test_change_is_bumpless(old: str, new: str) -> None:
    controller, torque = running(old)
    assert controller.activate(LAWS[new].number, PARAMETERS[new], torque)
    first = controller.step(0.03, 0.1, 0.0, 0.028, 0.09, torque, DT)
    assert first.u == pytest.approx(torque, abs=1e-9)
    assert first.u == pytest.approx(first.feedback + first.friction + first.other, abs=1e-12)


@pytest.mark.parametrize("gains", ["demo_local_certified", "demo_local", "demo_local_stiff", "demo_pd_dob"])
def test_a_change_under_a_following_error_goes_straight_to_what_the_new_law_asks(gains: str) -> None:
    """A joint that sticks 25 mrad from its reference: never a torque below that of before, and no step on the way."""
    controller, error = Controller(), 0.025
    controller.activate(LawNumber.PD, (2.5, 0.12, 0.0), 0.0)
    before = applied = 2.5 * error
    new = load_gains(shipped(f"gains/{gains}.yaml"))
    assert controller.activate(new.law.number, new.pack(), before)
    asked = []
    for _ in range(20):
        applied = controller.step(error, 0.0, 0.0, 0.0, 0.0, applied, DT).u
        asked.append(applied)
    assert asked[0] == pytest.approx(before, abs=1e-9)
    assert min(asked) >= before - 1e-3 and asked == sorted(asked)
    assert max(b - a for a, b in itertools.pairwise(asked)) < 0.1


def test_offset_decays_with_the_stated_time_constant() -> None:
    controller = Controller()
    controller.activate(LawNumber.PD, (2.5, 0.12, 0.0), 0.05)
    outputs = [controller.step(0.0, 0.0, 0.0, 0.0, 0.0, 0.05, DT).u for _ in range(3001)]
    assert outputs[0] == 0.05
    assert outputs[100] == pytest.approx(0.05 * math.exp(-0.1 / BUMPLESS_TIME_S), rel=1e-9)
    assert outputs[-1] == 0.0


@pytest.mark.parametrize(("old", "new"), [("local", "pd_lugre"), ("pd_lugre", "local"), ("local", "local")])
def test_friction_state_is_carried_over(old: str, new: str) -> None:
    controller, torque = running(old)
    before = controller.friction_state
    assert before != 0.0
    controller.activate(LAWS[new].number, PARAMETERS[new], torque)
    assert controller.friction_state == pytest.approx(before)


def test_friction_state_is_carried_as_torque_when_the_stiffness_differs() -> None:
    controller, torque = running("local")
    before = controller.friction_state * SIGMA0
    softer = local_gains()._replace(stiffness=0.8 * SIGMA0).flat()
    controller.activate(LawNumber.LOCAL, softer, torque)
    assert controller.friction_state * 0.8 * SIGMA0 == pytest.approx(before)


def test_disturbance_estimate_is_carried_within_a_law_only() -> None:
    controller, torque = running("pd_dob")
    before = controller.disturbance
    assert before != 0.0
    controller.activate(LawNumber.PD_DOB, PARAMETERS["pd_dob"], torque)
    assert controller.disturbance == before
    controller.activate(LawNumber.LOCAL, PARAMETERS["local"], torque)
    assert controller.disturbance == 0.0


def test_nan_does_not_outlive_a_change_of_gains() -> None:
    controller, torque = running("local")
    assert math.isnan(controller.step(0.0, 0.0, 0.0, math.nan, math.nan, torque, DT).u)
    controller.activate(LawNumber.LOCAL, PARAMETERS["local"], 0.0)
    assert math.isfinite(controller.step(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, DT).u)


def test_reset_forgets_and_starts_from_the_given_torque() -> None:
    controller, _ = running("local")
    controller.reset(0.012)
    assert (controller.friction_state, controller.disturbance) == (0.0, 0.0)
    assert controller.step(0.0, 0.0, 0.0, 0.001, 0.0, 0.012, DT).u == pytest.approx(0.012, abs=1e-12)


def test_starts_without_torque() -> None:
    assert Controller().step(1.0, 1.0, 1.0, 0.0, 0.0, 0.0, DT).u == 0.0


def test_a_bumpless_offset_is_no_limit_to_the_anti_windup() -> None:
    controller = Controller()
    controller.activate(LawNumber.LOCAL, local_parameters(gain=0.04), -0.05)
    applied, states = -0.05, [0.0]
    for _ in range(4):  # asked and applied agree all the time, so l goes on as soon as there is an error
        applied = controller.step(1e-3, 0.0, 0.0, 0.0, 0.0, applied, DT).u
        states.append(controller.friction_state)
    assert states[1:] == sorted(set(states))  # the first step begins with the reference where the joint stands


@pytest.mark.parametrize(
    ("number", "parameters"),
    [
        (0, PARAMETERS["pd"]),
        (5, PARAMETERS["pd"]),
        (LawNumber.PD, PARAMETERS["pd"][:-1]),
        (LawNumber.PD_DOB, (*PARAMETERS["pd_dob"], 0.0)),
        (LawNumber.PD_LUGRE, PARAMETERS["pd_lugre"][:-1]),
        (LawNumber.LOCAL, PARAMETERS["local"][:-1]),
        (LawNumber.LOCAL, PARAMETERS["local"][: local.N_SETS]),
        (LawNumber.LOCAL, (*PARAMETERS["local"][: local.N_SETS], math.nan, *PARAMETERS["local"][local.FIRST_NODE :])),
    ],
)
def test_wrong_law_or_length_is_refused_and_changes_nothing(number: int, parameters: tuple[float, ...]) -> None:
    controller, torque = running("pd")
    twin, _ = running("pd")
    assert not controller.activate(number, parameters, 0.5)
    arguments = (0.03, 0.1, 0.0, 0.028, 0.09, torque, DT)
    assert controller.step(*arguments) == twin.step(*arguments)
    assert controller.law.name == "pd"


def test_registry_numbers_are_stable_and_sizes_bounded() -> None:
    assert {name: int(law.number) for name, law in LAWS.items()} == {"pd": 1, "pd_dob": 2, "pd_lugre": 3, "local": 4}
    nodes = tuple(-1.0 + k / 32 for k in range(MAX_SETS))
    assert len(local_parameters(nodes)) <= MAX_PARAMETERS
    assert LAWS["local"].accepts(local_parameters(nodes))


@pytest.mark.parametrize("name", LAWS)
def test_the_loop_reads_every_parameter_from_a_slot(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[Any] = []

    def step(p: Any, *rest: Any) -> tuple[float, float, float, float]:
        seen.append(p)
        return 0.0, 0.0, 0.0, 0.0

    law = replace(LAWS[name], step=step)
    monkeypatch.setitem(LAW_BY_NUMBER, int(law.number), law)
    controller = Controller()
    assert controller.activate(law.number, PARAMETERS[name], 0.0)
    controller.step(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, DT)
    pairs = [(seen[0], GAINS[name])]
    if name == "local":
        pairs += [(getattr(seen[0], field), getattr(GAINS[name], field)) for field in ("sets", "position")]
    for slotted, named in pairs:
        assert not hasattr(slotted, "__dict__")
        assert all(inspect.ismemberdescriptor(getattr(type(slotted), field)) for field in named._fields)
        plain = [field for field in named._fields if field not in ("sets", "position")]
        assert [getattr(slotted, f) for f in plain] == [getattr(named, f) for f in plain]


@pytest.mark.parametrize("name", LAWS)
def test_slots_change_no_bit(name: str) -> None:
    named = GAINS[name]
    if name == "local":
        known = PositionTorques(lead=0.001, spring=0.2, waves=(0.1, 36.0, 0.2))
        named = named._replace(knows_position=True, position=known)
    slotted, states = in_slots(named), (LawState(), LawState())
    for k in range(500):
        v = 0.7 * math.sin(0.03 * k) ** 3
        arguments = (math.sin(0.01 * k), math.cos(0.01 * k), -v, math.sin(0.01 * k) - 1e-3 * v, v, states[0].asked, DT)
        step = LAWS[name].step
        assert step(slotted, states[0], *arguments) == step(named, states[1], *arguments)
    assert astuple(states[0]) == astuple(states[1])
