"""A certified set for Table I's joint, made once; the certificate's simulations are few, its promise is whole."""

from __future__ import annotations

from functools import cache

import pytest

from servod.formats.gains.gain_set import GainSet
from servod.lab.verify import validation
from servod.lab.verify.certify import verify
from tests.lab.synthesize.designs import table1_set


@cache
def certified() -> GainSet:
    """The set with a valid certificate."""
    result = verify(table1_set(), plants=2, processes=1, least_plants=2)
    assert result.valid, [check for check in result.checks if not check.passed]
    return result.certified(table1_set())


def shorten_validation(patch: pytest.MonkeyPatch) -> None:
    """The validation motion, and the promise for it, take half of the usual time."""
    patch.setattr(validation, "SLOW_HZ", 2.0)
    patch.setattr(validation, "BRISK_PERIODS", 8)


@cache
def certified_in_short() -> GainSet:
    """`certified`, with its promise for the shortened motion."""
    found = certified()
    assert found.design is not None and found.certificate is not None
    with pytest.MonkeyPatch.context() as patch:
        shorten_validation(patch)
        promised = validation.promise(found, found.design, 1)
    certificate = found.certificate.model_copy(update={"promised": promised})
    return found.model_copy(update={"certificate": certificate}).sealed()
