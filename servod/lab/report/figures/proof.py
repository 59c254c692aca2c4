"""The certificate of a gain set as a table: every check with its figure, limit and margin.

Stands on the gain set alone.
"""

from __future__ import annotations

from servod.common.errors import BadInput
from servod.formats.gains.gain_set import Certificate, GainSet
from servod.lab.report.figure import Table


def certificate_table(gains: GainSet) -> Table:
    """All checks in their order. Raises BadInput for a set without a certificate."""
    certificate = _certificate(gains)
    rows = [
        (c.name, f"{c.value:.4g}", f"{c.limit:.4g}", f"{c.margin:.3g}", _verdict(c.passed)) for c in certificate.checks
    ]
    verdict = "valid" if certificate.valid else "not valid"
    return Table(f"Certificate: {verdict}", ("check", "figure", "limit", "margin", "verdict"), tuple(rows))


def observations_table(gains: GainSet) -> Table:
    """What was observed beside the checks, told and not judged. Raises BadInput for a set without a certificate."""
    told = _certificate(gains).observations
    return Table("Told, not judged", ("figure", "value"), tuple((k, f"{v:.4g}") for k, v in told.items()))


def _certificate(gains: GainSet) -> Certificate:
    if gains.certificate is None:
        raise BadInput(f"gain set {gains.name}: certificate", "nothing", "one that `servoctl verify` wrote")
    return gains.certificate


def _verdict(passed: bool) -> str:
    return "passed" if passed else "failed"
