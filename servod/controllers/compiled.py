"""Compiles a control law with numba: the same function that the loop runs, for the simulator.

Beside the data path; needs the `lab` extra. Parameters and state are float64 arrays then.
"""

from __future__ import annotations

import functools
import types
from collections.abc import Callable
from typing import Any

from servod.controllers import Law

_PACKAGE = "servod.controllers"


@functools.cache
def compiled(function: Callable[..., Any]) -> Any:
    """`function` compiled by numba, and with it every function of this package that it calls.

    The source stays free of decorators, so that the loop imports no compiler: the function is copied with its globals
    and the helpers that it names are replaced by their compiled selves. Raises ImportError without numba.
    """
    import numba

    assert isinstance(function, types.FunctionType)
    names = {name: function.__globals__[name] for name in function.__code__.co_names if name in function.__globals__}
    helpers = {name: compiled(value) for name, value in names.items() if _is_ours(value)}
    copy = types.FunctionType(function.__code__, {**function.__globals__, **helpers}, function.__name__)
    return numba.njit(copy)


def _is_ours(value: object) -> bool:
    return isinstance(value, types.FunctionType) and value.__module__.startswith(_PACKAGE)


def compiled_step(law: Law) -> Any:
    """The law's step, compiled; call with float64 arrays for parameters and state, otherwise as `Law.step`."""
    return compiled(law.step)
