"""Feed-forward over position: the torque it gives, its packing, and that the observer does not count it twice."""

from __future__ import annotations

import math

import numpy as np
import pytest

from servod.formats.gains.parameters import PositionFeedforward, PositionWave
from servod.kernels.laws import LAWS, MAX_PARAMETERS, MAX_SETS
from servod.kernels.laws.position import MAX_SIZE, MAX_WAVES, fits, position_torque
from servod.kernels.laws.state import ASKED, DISTURBANCE
from servod.kernels.physics.compiled import compiled
from tests.kernels.laws.cases import fresh_state, local_parameters

KNOWN = PositionFeedforward(
    lead_s=0.0015,
    offset_nm=-0.002,
    spring_nm_per_rad=0.03,
    spring_rest_rad=0.2,
    spring_cubic_nm_per_rad3=0.5,
    waves=[PositionWave(amplitude_nm=0.1, waves_per_turn=1.0), PositionWave(amplitude_nm=0.004, waves_per_turn=36.0)],
)


@pytest.mark.parametrize(("x", "v"), [(0.0, 0.0), (0.7, -0.3), (-2.0, 0.5)])
def test_the_torque_is_the_sum_of_what_is_known_at_the_led_reference(x: float, v: float) -> None:
    led = x + 0.0015 * v
    waves = 0.1 * math.sin(led) + 0.004 * math.sin(36.0 * led)
    expected = -0.002 + 0.03 * (led - 0.2) + 0.5 * (led - 0.2) ** 3 + waves
    assert position_torque(KNOWN.pack(), 0, x, v) == pytest.approx(expected, rel=1e-12)


def test_the_law_adds_it_and_works_without_it() -> None:
    plain = local_parameters(bandwidth=50.0)
    arguments = (0.3, 0.1, 0.0, 0.3, 0.1, 0.0, 0.001)
    without = LAWS["local"].step(plain, fresh_state("local"), *arguments)
    with_it = LAWS["local"].step((*plain, *KNOWN.pack()), fresh_state("local"), *arguments)
    known = position_torque(KNOWN.pack(), 0, 0.3, 0.1)
    assert with_it[0] - without[0] == pytest.approx(known) and with_it[3] - without[3] == pytest.approx(known)


def test_the_observer_takes_what_is_fed_forward_for_known() -> None:
    """A joint at rest under the known torque alone needs no estimate; without the feed-forward it is all estimate."""
    plain, known = local_parameters(bandwidth=50.0), position_torque(KNOWN.pack(), 0, 0.3, 0.0)
    estimates = []
    for packed in ((*plain, *KNOWN.pack()), plain):
        state = fresh_state("local")
        for _ in range(300):
            LAWS["local"].step(packed, state, 0.3, 0.0, 1e-9, 0.3, 0.0, known, 0.001)
        estimates.append(state[DISTURBANCE])
    assert estimates == pytest.approx([0.0, known], abs=1e-6)


def test_compiled_equals_plain() -> None:
    packed = (*local_parameters(gain=0.04, bandwidth=50.0), *KNOWN.pack())
    kernel, state, plain_state = compiled(LAWS["local"].step), np.array(fresh_state("local")), fresh_state("local")
    for k in range(200):
        x, v = math.sin(0.05 * k), math.cos(0.05 * k)
        plain = LAWS["local"].step(packed, plain_state, x, v, 0.0, x - 1e-3, v, plain_state[ASKED], 0.001)
        assert kernel(np.array(packed), state, x, v, 0.0, x - 1e-3, v, state[ASKED], 0.001) == pytest.approx(plain)


def test_only_whole_blocks_are_accepted() -> None:
    plain, law = local_parameters(), LAWS["local"]
    assert law.accepts((*plain, *KNOWN.pack()))
    assert not law.accepts((*plain, *KNOWN.pack()[:-1]))
    assert not law.accepts((*plain, 0.0))
    assert [fits(size) for size in (0, 4, 5, 8, MAX_SIZE, MAX_SIZE + 3)] == [True, False, True, True, True, False]


def test_the_largest_set_fits_into_the_command() -> None:
    most = KNOWN.model_copy(update={"waves": KNOWN.waves[:1] * MAX_WAVES})
    packed = (*local_parameters(tuple(-1.0 + k / 32 for k in range(MAX_SETS))), *most.pack())
    assert len(packed) == MAX_PARAMETERS and LAWS["local"].accepts(packed)
