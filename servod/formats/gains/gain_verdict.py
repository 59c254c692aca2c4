"""Whether a gain set counts as certified, and if not: which key says so, what stands there, and what helps.

Beside servod.formats.gains.gain_set, which every refusal of a set comes from.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from servod.formats.gains.gain_set import GainSet


class GainFault(NamedTuple):
    """Why a set does not count: the key of its file, what was found there in a few words, and what is wanted."""

    key: str
    problem: str
    remedy: str


_VERIFY = "a valid one (`servoctl verify` issues it)"
_REMAKE = "the file as servoctl wrote it; for other numbers make the set anew (`servoctl synthesize`, then `verify`)"


def seal_fault(gains: GainSet) -> GainFault | None:
    """Why the seal does not count; None when it fits, or when there is neither seal nor design."""
    if gains.seal is None:
        return None if gains.design is None else GainFault("seal", "no seal, although the set has a design", _REMAKE)
    if gains.seal == gains.content_sha256():
        return None
    what = "numbers that were changed after the set was sealed"
    return GainFault("seal", what if gains.certificate else f"{what}, or a certificate that was taken out", _REMAKE)


def certificate_fault(gains: GainSet) -> GainFault | None:
    """Why the set does not count as certified; None when it does."""
    certificate = gains.certificate
    if fault := seal_fault(gains):
        return fault
    if certificate is None:
        return GainFault("certificate", "no certificate", _VERIFY)
    if gains.design is None or gains.seal is None:
        missing = "design" if gains.design is None else "seal"
        return GainFault(missing, "a certificate without the design that it is of and its seal", _REMAKE)
    if not certificate.valid:
        return GainFault("certificate", "a certificate that says valid: false", _VERIFY)
    if certificate.parameters_sha256 != gains.parameters_sha256():
        what = "a certificate for other parameters (they were changed after it was issued)"
        return GainFault("certificate.parameters_sha256", what, _VERIFY)
    if certificate.model_sha256 not in (None, gains.provenance.model_sha256):
        what = "a certificate for another axis model than provenance.model_sha256 says"
        return GainFault("certificate.model_sha256", what, _VERIFY)
    return None
