"""`servoctl verify` without the command line: all checks of a gain set, and the certificate that they make.

Top of servod.lab.verify. A set is judged from itself alone: model, intervals and proofs stand in its design.
"""

from __future__ import annotations

import datetime
from dataclasses import dataclass
from typing import Any, Literal

from servod import __version__
from servod.common.errors import BadInput
from servod.common.sources import VERIFIES, source_sha256
from servod.formats.gains.gain_set import Certificate, CertificateCheck, GainSet, Promise
from servod.lab.verify.checks import LEAST_PLANTS, SIMULATED, STATIC, Subject, at_most, observations
from servod.lab.verify.effect_checks import check_effects
from servod.lab.verify.feedforward import check_feedforward
from servod.lab.verify.pushes import check_pushes
from servod.lab.verify.reference_proof import check_reference
from servod.lab.verify.rest_checks import check_loads, check_rest
from servod.lab.verify.trials import scale_of
from servod.lab.verify.validation import promise

SEED, PROCESSES = 1, 2
#: No Lyapunov function over all speeds stands behind the poles and margins: each is of one constant speed.
STABILITY: Literal["frozen"] = "frozen"


@dataclass(frozen=True, slots=True)
class Verification:
    """The outcome: every check with figure, limit and margin, and what is told beside."""

    checks: list[CertificateCheck]
    observations: dict[str, float]
    promised: Promise | None = None
    least_rate_nm_per_s: float | None = None

    @property
    def valid(self) -> bool:
        """Whether every check passed."""
        return all(check.passed for check in self.checks)

    def document(self) -> dict[str, Any]:
        """Plain values, as `servoctl verify --json` prints them."""
        return {
            "stability": STABILITY,
            "valid": self.valid,
            "checks": [check.model_dump() for check in self.checks],
            "observations": self.observations,
            "promised": self.promised and self.promised.model_dump(),
        }

    def certificate(self, gains: GainSet) -> Certificate:
        """The certificate for these very gains."""
        return Certificate(
            stability=STABILITY,
            valid=self.valid,
            parameters_sha256=gains.parameters_sha256(),
            model_sha256=gains.provenance.model_sha256,
            data_sha256=list(gains.provenance.data_sha256),
            tool_sha256=source_sha256(VERIFIES),
            issued_by=f"servod {__version__} verify, source {source_sha256(VERIFIES)[:16]}",
            issued_at=today(),
            checks=self.checks,
            observations=self.observations,
            promised=self.promised,
            torque_nm=scale_of(gains.design).torque_nm if gains.design else None,
            torque_rate_nm_per_s=self.least_rate_nm_per_s if self.valid else None,
        )

    def certified(self, gains: GainSet) -> GainSet:
        """`gains` with the certificate, valid or not, sealed and unsigned; a seal that was broken stays so."""
        judged = gains.model_copy(update={"certificate": self.certificate(gains), "signature": None})
        return judged if gains.seal_broken else judged.sealed()


def today() -> datetime.datetime:
    """The day, UTC: the same set verified again on the same day is the same file, byte for byte."""
    return datetime.datetime.combine(datetime.datetime.now(datetime.UTC).date(), datetime.time(), datetime.UTC)


def verify(
    gains: GainSet,
    plants: int = LEAST_PLANTS,
    seed: int = SEED,
    processes: int = PROCESSES,
    where: str = "gain set",
    *,
    least_plants: int = LEAST_PLANTS,
) -> Verification:
    """Judge `gains` by its own design, valid with `least_plants` and more. Raises BadInput when it has none.

    Simulations run only when everything cheaper has passed: what is refused is refused at once.
    """
    if gains.design is None:
        raise BadInput(f"{where}: design", "nothing", "a design, as `servoctl synthesize` writes it")
    subject = Subject(gains, gains.design, plants, seed, processes, least_plants)
    cheap = (*STATIC, check_feedforward, check_rest, check_effects, check_reference)
    checks = [check for judge in cheap for check in judge(subject)]
    if not all(check.passed for check in checks):
        return Verification(checks, {})
    checks += [check for judge in (*SIMULATED, check_loads, check_pushes) for check in judge(subject)]
    promised = promise(gains, gains.design, seed)
    checks.append(
        at_most("validation motion that a plant does not get through (0 no, 1 yes)", float(not promised), 0.0)
    )
    return Verification(checks, observations(subject), promised, subject.least_rate_nm_per_s)
