"""The set that other tests read from a file is the one that synthesis makes today."""

from __future__ import annotations

import pytest

from servod.formats.gains.parameters import LocalParameters
from tests.lab.synthesize.designs import made_anew, table1_set

#: Solvers end within this share of each other from one machine to the next.
SOLVER_SHARE = 1e-3


def test_the_kept_set_is_what_synthesis_makes() -> None:
    """Where this fails after a change of synthesis, `python -m tests.lab.synthesize.designs` writes the file anew."""
    kept, made = table1_set(), made_anew()
    assert not kept.seal_broken and not made.seal_broken
    assert kept.pack() == pytest.approx(made.pack(), rel=SOLVER_SHARE, abs=1e-9)
    assert kept.design is not None and made.design is not None
    assert kept.design.model_dump(exclude={"regions"}) == made.design.model_dump(exclude={"regions"})
    for old, new in zip(kept.design.regions, made.design.regions, strict=True):
        assert [v.name for v in old.vertices] == [v.name for v in new.vertices]
    for law in (kept.parameters, made.parameters):
        assert isinstance(law, LocalParameters)
