"""How the programmes are solved: Clarabel (interior point) by default, SCS (first order) to cross-check.

Under both LMI programmes. An inaccurate solution is no failure: what comes out is judged by eigenvalues, not by its
label.
"""

from __future__ import annotations

import warnings
from typing import Any

import cvxpy as cp

SOLVED = ("optimal", "optimal_inaccurate")
#: SCS reaches the objective to a percent at this tolerance in a few seconds; at its own 1e-5 it takes twenty.
OPTIONS: dict[str, dict[str, Any]] = {"SCS": {"eps": 3e-5, "max_iters": 15_000}}


def solved(problem: Any, solver: str) -> bool:
    """Solve `problem` in place; whether it has a solution."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            problem.solve(solver=solver, **OPTIONS.get(solver, {}))
    except cp.error.SolverError:
        return False
    return problem.status in SOLVED
