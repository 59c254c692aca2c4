"""Feed-forward over position: the torque it gives, its packing, and that the observer does not count it twice."""

from __future__ import annotations

import math

import pytest

from servod.formats.gains.parameters import PositionFeedforward, PositionWave
from servod.kernels.laws import LAWS, MAX_PARAMETERS, MAX_SETS
from servod.kernels.laws.position import MAX_SIZE, MAX_WAVES, fits, position_torque
from servod.kernels.laws.state import LawState
from servod.kernels.physics.compiled import arrays, compiled, record
from tests.kernels.laws.cases import local_gains, local_parameters

KNOWN = PositionFeedforward(
    lead_s=0.0015,
    offset_nm=-0.002,
    spring_nm_per_rad=0.03,
    spring_rest_rad=0.2,
    spring_cubic_nm_per_rad3=0.5,
    waves=[PositionWave(amplitude_nm=0.1, waves_per_turn=1.0), PositionWave(amplitude_nm=0.004, waves_per_turn=36.0)],
)
FED = {"knows_position": True, "position": KNOWN.named()}


@pytest.mark.parametrize(("x", "v"), [(0.0, 0.0), (0.7, -0.3), (-2.0, 0.5)])
def test_the_torque_is_the_sum_of_what_is_known_at_the_led_reference(x: float, v: float) -> None:
    led = x + 0.0015 * v
    waves = 0.1 * math.sin(led) + 0.004 * math.sin(36.0 * led)
    expected = -0.002 + 0.03 * (led - 0.2) + 0.5 * (led - 0.2) ** 3 + waves
    assert position_torque(KNOWN.named(), x, v) == pytest.approx(expected, rel=1e-12)


def test_the_law_adds_it_and_works_without_it() -> None:
    plain = local_gains(bandwidth=50.0)
    arguments = (0.3, 0.1, 0.0, 0.3, 0.1, 0.0, 0.001)
    without = LAWS["local"].step(plain, LawState(), *arguments)
    with_it = LAWS["local"].step(plain._replace(**FED), LawState(), *arguments)
    known = position_torque(KNOWN.named(), 0.3, 0.1)
    assert with_it[0] - without[0] == pytest.approx(known) and with_it[3] - without[3] == pytest.approx(known)


def test_the_observer_takes_what_is_fed_forward_for_known() -> None:
    """A joint at rest under the known torque alone needs no estimate; without the feed-forward it is all estimate."""
    plain, known = local_gains(bandwidth=50.0), position_torque(KNOWN.named(), 0.3, 0.0)
    estimates = []
    for p in (plain._replace(**FED), plain):
        state = LawState()
        for _ in range(300):
            LAWS["local"].step(p, state, 0.3, 0.0, 1e-9, 0.3, 0.0, known, 0.001)
        estimates.append(state.d_hat)
    assert estimates == pytest.approx([0.0, known], abs=1e-6)


def test_compiled_equals_plain() -> None:
    p = local_gains(gain=0.04, bandwidth=50.0)._replace(**FED)
    kernel, (state, memory), plain_state = compiled(LAWS["local"].step), record(LawState()), LawState()
    for k in range(200):
        x, v = math.sin(0.05 * k), math.cos(0.05 * k)
        plain = LAWS["local"].step(p, plain_state, x, v, 0.0, x - 1e-3, v, plain_state.asked, 0.001)
        assert kernel(arrays(p), memory[0], x, v, 0.0, x - 1e-3, v, state.asked, 0.001) == pytest.approx(plain)


def test_only_whole_blocks_are_accepted() -> None:
    plain, law = local_parameters(), LAWS["local"]
    assert law.accepts((*plain, *KNOWN.named().flat()))
    assert not law.accepts((*plain, *KNOWN.named().flat()[:-1]))
    assert not law.accepts((*plain, 0.0))
    assert [fits(size) for size in (0, 4, 5, 8, MAX_SIZE, MAX_SIZE + 3)] == [True, False, True, True, True, False]


def test_the_largest_set_fits_into_the_command() -> None:
    most = KNOWN.model_copy(update={"waves": KNOWN.waves[:1] * MAX_WAVES})
    packed = (*local_parameters(tuple(-1.0 + k / 32 for k in range(MAX_SETS))), *most.named().flat())
    assert len(packed) == MAX_PARAMETERS and LAWS["local"].accepts(packed)
