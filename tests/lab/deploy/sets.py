"""A certified set for Table I's joint, made once; the certificate's simulations are few, its promise is whole."""

from __future__ import annotations

from functools import cache

from servod.formats.gains.gain_set import GainSet
from servod.lab.verify.certify import verify
from tests.lab.synthesize.designs import table1_set


@cache
def certified() -> GainSet:
    """The set with a valid certificate."""
    result = verify(table1_set(), plants=2, processes=1, least_plants=2)
    assert result.valid, [check for check in result.checks if not check.passed]
    return result.certified(table1_set())
