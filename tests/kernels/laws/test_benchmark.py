"""The controller benchmark: it times what it says, with parameters that the laws accept."""

from __future__ import annotations

from servod.kernels.laws import LAWS, local
from servod.qualify.bench.tick import PARAMETERS, controller_benchmark


def test_times_every_law() -> None:
    timings = controller_benchmark(n_steps=200)
    assert [timing.law for timing in timings] == list(LAWS)
    assert all(0.0 < timing.median_us <= timing.p99_us for timing in timings)


def test_parameters_are_legal_and_local_has_nine_sets() -> None:
    assert all(LAWS[name].accepts(p) for name, p in PARAMETERS.items())
    assert PARAMETERS["local"][local.N_SETS] == 9.0
