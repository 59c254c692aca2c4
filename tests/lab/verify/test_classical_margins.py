"""Gain, phase, delay margin and Ms against loops whose margins are known in closed form."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import brentq

from servod.lab.verify.closed_loop import spectral_radius
from servod.lab.verify.margins import (
    DELAY,
    DOWN,
    FINE_CIRCLE,
    MARGINS,
    PEAK,
    PHASE,
    UP,
    classical_margins,
    describe_margins,
    sensitivity,
)

ANGLE = np.angle(FINE_CIRCLE)


def integrator(gain: float, delay: int) -> np.ndarray:
    """L of y(k+1) = y(k) + u(k), u = -gain*y of `delay` cycles ago."""
    z = FINE_CIRCLE
    return gain / (z - 1.0) * z**-delay


@pytest.mark.parametrize(("gain", "delay"), [(0.05, 0), (0.2, 1), (0.1, 3)])
def test_a_delayed_integrator_has_the_margins_of_its_closed_form(gain: float, delay: int) -> None:
    """1/(z - 1) at angle w: size 1/(2 sin(w/2)), phase -(pi + w)/2; so every crossing is known."""
    found = classical_margins(integrator(gain, delay), ANGLE)
    w_phase = np.pi / (1.0 + 2.0 * delay)  # -(pi + w)/2 - delay*w = -pi
    w_gain = 2.0 * np.arcsin(gain / 2.0)
    lag = np.pi - (np.pi + w_gain) / 2.0 - delay * w_gain
    assert found[UP] == pytest.approx(20.0 * np.log10(2.0 * np.sin(w_phase / 2.0) / gain), abs=0.01)
    assert found[DOWN] == np.inf
    assert found[PHASE] == pytest.approx(np.degrees(lag), abs=0.01)
    assert found[DELAY] == pytest.approx(lag / w_gain, rel=1e-4)
    dense = np.linspace(1e-3, np.pi, 200_001)
    z = np.exp(1j * dense)
    assert found[PEAK] == pytest.approx(np.abs(1.0 / (1.0 + gain / (z - 1.0) * z**-delay)).max(), rel=1e-3)


def test_an_unstable_axis_has_a_margin_downwards_too() -> None:
    """y(k+1) = p*y(k) + u(k), u = -g*y(k): stable for p - 1 < g < p + 1."""
    p, g = 1.02, 0.3
    found = classical_margins(g / (FINE_CIRCLE - p), ANGLE)
    assert found[UP] == pytest.approx(20.0 * np.log10((1.0 + p) / g), abs=0.01)
    assert found[DOWN] == pytest.approx(20.0 * np.log10(g / (p - 1.0)), abs=0.01)
    w = brentq(lambda a: abs(g / (np.exp(1j * a) - p)) - 1.0, 1e-3, np.pi)
    phase = np.angle(g / (np.exp(1j * w) - p))
    assert found[PHASE] == pytest.approx(abs(np.degrees((phase + np.pi + np.pi) % (2 * np.pi) - np.pi)), abs=0.01)


def test_margins_are_where_the_closed_loop_ends_to_be_stable() -> None:
    """A double integrator under PD on the last-but-one sample: poles of the loop, moved by each margin, reach 1."""
    t, k, d = 1.0, 0.01, 0.2
    plant, force = np.array([[1.0, t], [0.0, 1.0]]), np.array([0.5 * t * t, t])

    def closed(gain: float, waits: int) -> np.ndarray:
        """States (x, v, u of the last cycles); u = -gain*(k*x + d*v), acting `waits` cycles later."""
        n = 2 + waits
        a = np.zeros((n, n))
        a[:2, :2] = plant
        feedback = -gain * np.array([k, d])
        if waits == 0:
            a[:2, :2] += np.outer(force, feedback)
        else:
            a[:2, -1], a[2, :2] = force, feedback
            a[3:, 2:-1] = np.eye(waits - 1)
        return a

    z = FINE_CIRCLE
    loop = np.array([[k, d] @ np.linalg.solve(one * np.eye(2) - plant, force) / one for one in z])
    found = classical_margins(loop, ANGLE)
    assert spectral_radius(closed(1.0, 1)[None])[0] < 1.0
    at_edge = 10.0 ** (found[UP] / 20.0)
    assert (
        spectral_radius(closed(0.999 * at_edge, 1)[None])[0]
        < 1.0
        < spectral_radius(closed(1.001 * at_edge, 1)[None])[0]
    )
    waits = int(found[DELAY])
    assert spectral_radius(closed(1.0, 1 + waits)[None])[0] < 1.0 < spectral_radius(closed(1.0, 2 + waits)[None])[0]
    # The same L from S, as the certificate has it: the command enters where u is kept, the row reads the feedback.
    column, row = np.array([0.0, 0.0, 1.0]), np.array([-k, -d, 0.0])
    response = sensitivity(closed(1.0, 1)[None], column[None], row, on_circle=FINE_CIRCLE)[0]
    again = classical_margins(1.0 / response - 1.0, ANGLE)
    assert again == pytest.approx(found, rel=1e-6)


def test_margins_read_as_one_clause() -> None:
    told = {UP: 6.02, PHASE: 45.0, DELAY: 2.5, PEAK: 1.8, "largest pole": 0.9}
    assert describe_margins(told) == (
        "gain margin upward 6.02 dB, phase margin 45°, delay margin 2.5 cycles, peak sensitivity Ms 1.8"
    )
    assert describe_margins({"largest pole": 0.9}) == ""
    assert set(MARGINS) == {UP, DOWN, PHASE, DELAY, PEAK}
