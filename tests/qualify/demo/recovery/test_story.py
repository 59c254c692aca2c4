"""What the page says of certificates: how much uncertainty they stand for, and whether a promise was broken."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from servod.formats.gains.design import Design
from servod.formats.gains.gain_set import Certificate, GainSet, Promise
from servod.lab.deploy.outcome import Deployment, Ending
from servod.lab.recordings.recording import ROW, Rows
from servod.lab.verify.validation import Figures, Part
from servod.qualify.demo.recovery.walk import Designed, Retrofit, story

PROMISED = Promise.model_construct(slow_rad=1e-4, brisk_rad=1e-4, hold_rad=1e-4)


def tracked(error_rad: float) -> Rows:
    """Three seconds of cycles with the same error."""
    rows = np.zeros(3000, dtype=ROW)
    rows["time_ns"], rows["reference_rad"] = np.arange(3000) * 1_000_000, error_rad
    return rows


def designed(scale: float) -> Designed:
    """A set with a promise."""
    certificate = Certificate.model_construct(promised=PROMISED)
    design = Design.model_construct(counts_per_turn=2.0**20)
    return Designed(GainSet.model_construct(design=design, certificate=certificate), scale)


def recovery(slow_rad: float) -> Retrofit:
    """A story whose first set left `slow_rad` on the slow sine of the validation motion."""
    before = Figures({Part.SLOW: (slow_rad,), Part.BRISK: (5e-5,), Part.HOLD: (5e-5,)})
    done = Deployment(Ending.KEPT, (), "second", 1, PROMISED, before, None, None, None)
    rows = (tracked(1e-5), tracked(2e-5), tracked(1e-5))
    nothing: Any = None  # no figure of the diagnosis is told here
    return Retrofit("gravity", *rows, nothing, {"findings": []}, designed(1.0), designed(0.25), done)


@pytest.mark.parametrize(("slow_rad", "said"), [(5e-4, "worse than the certificate promised"), (5e-5, "all the same")])
def test_a_promise_is_called_broken_only_where_it_was(slow_rad: float, said: str) -> None:
    found = recovery(slow_rad)
    assert said in story(found)[1]
    assert ("0.5 mrad; the certificate promised 0.1" in story(found)[1]) is bool(found.broken_promises)
    assert ("2 times as large" in story(found)[1]) is not bool(found.broken_promises)


def test_the_uncertainty_of_each_certificate_is_told() -> None:
    first, *_, second = story(recovery(5e-4))
    assert first.endswith("within the usual uncertainty of a model.")
    assert "within 0.25 of the usual uncertainty" in second
