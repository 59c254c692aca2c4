"""Gain sets: what a control law runs with, where it comes from, and whether it is certified.

Beside the data path: the supervisor loads a set, packs it into plain floats and sends these to the loop.
"""

from __future__ import annotations

import datetime
import hashlib
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import yaml
from pydantic import Field, model_validator

from servod.common.errors import BadInput
from servod.common.sources import VERIFIES, source_sha256
from servod.common.units import NS_PER_S, NS_PER_US
from servod.common.yaml import Dumper, Strict, parse_yaml, read_text, validate
from servod.formats.config import AxisConfig
from servod.formats.gains.design import Design
from servod.formats.gains.parameters import LocalSet, Parameters, PdParameters
from servod.formats.gains.signature import GainSignature, require_signature
from servod.formats.kinds import FileKind, require_kind
from servod.formats.model.axis_model import load_axis_model
from servod.formats.model.identified import Devices
from servod.kernels.laws import LAWS, Law

# --- The verdict on a set --------------------------------------------------------------------------------------------
# Whether a gain set counts as certified, and if not: which key says so, what stands there, and what helps.


class GainFault(NamedTuple):
    """Why a set does not count: the key of its file, what was found there in a few words, and what is wanted."""

    key: str
    problem: str
    remedy: str


_VERIFY = "a valid one (`servoctl verify` issues it)"
_REMAKE = "the file as servoctl wrote it; for other numbers make the set again (`servoctl synthesize`, then `verify`)"


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


Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
#: Lower case only: names become file names, also on systems that do not tell case apart.
NAME_PATTERN = r"^[a-z0-9][a-z0-9_.-]{0,63}$"
#: A model's delay may be so much of a cycle longer than the set's and still be the same: identified, it differs.
DELAY_SHARE = 0.1
GainName = Annotated[str, Field(pattern=NAME_PATTERN)]


class _Dumper(Dumper):
    """Writes one local set in one line, as a table."""

    def represent_mapping(self, tag: str, mapping: Any, flow_style: bool | None = None) -> yaml.MappingNode:
        in_one_line = isinstance(mapping, dict) and set(mapping) == set(LocalSet.model_fields)
        return super().represent_mapping(tag, mapping, in_one_line or flow_style)

    def represent_sequence(self, tag: str, sequence: Any, flow_style: bool | None = None) -> yaml.SequenceNode:
        """One row of a matrix in one line."""
        items = list(sequence)
        in_one_line = bool(items) and all(isinstance(item, float) for item in items)
        return super().represent_sequence(tag, items, in_one_line or flow_style)


class CrossCheck(Strict):
    """One region's programme solved by a second solver: both H2 bounds and whether they agree.

    A bound is missing where the solver found no solution; both missing agree as well.
    """

    region: str = Field(min_length=1, max_length=200)
    solver: str = Field(min_length=1, max_length=50, description="the second one")
    h2_bound: float | None = None
    other_h2_bound: float | None = None
    difference: float | None = Field(None, description="of the bounds, relative")
    tolerance: float
    agrees: bool = Field(strict=True)


class Provenance(Strict):
    """Where a gain set comes from; hashes are sha256 of the files' bytes."""

    author: str = Field(min_length=1, max_length=200)
    date: datetime.date
    tool: str = Field("by hand", min_length=1, max_length=200, description="program and version that computed it")
    tool_sha256: Sha256 | None = None
    model_sha256: Sha256 | None = Field(None, description="axis model that it was designed for")
    data_sha256: list[Sha256] = Field(default_factory=list, description="recordings that the model was identified from")
    seed: int | None = None
    cross_checks: list[CrossCheck] | None = Field(None, description="of the synthesis, by a second solver")
    note: str = Field("", max_length=4000)


class CertificateCheck(Strict):
    """One proven statement: its figure, the limit it must keep, and the margin between them (positive: kept)."""

    name: str = Field(min_length=1, max_length=200)
    value: float
    limit: float
    margin: float
    passed: bool


class Promise(Strict):
    """What a certified set shows on the validation motion (servod.lab.verify.validation), as the worst of `plants`
    plants.

    RMS error on the slow and on the brisk sine, peak to peak of the position while it holds after a step.
    """

    slow_rad: float = Field(ge=0.0)
    brisk_rad: float = Field(ge=0.0)
    hold_rad: float = Field(ge=0.0)
    plants: int = Field(ge=1)


class Certificate(Strict):
    """Statement that the gains were verified; bound to these very numbers by their hash."""

    stability: Literal["frozen"] | None = Field(
        None, description="frozen: judged at constant speeds; what happens from one to another simulations alone show"
    )
    valid: bool = Field(strict=True)
    parameters_sha256: Sha256
    model_sha256: Sha256 | None = None
    data_sha256: list[Sha256] | None = Field(None, description="recordings that the model was identified from")
    tool_sha256: Sha256 | None = Field(None, description="sources of the program that verified")
    issued_by: str = Field(min_length=1, max_length=200, description="program and version that verified")
    issued_at: datetime.datetime
    checks: list[CertificateCheck] = Field(default_factory=list)
    observations: dict[str, float] = Field(default_factory=dict, description="figures that are told, not judged")
    promised: Promise | None = Field(None, description="what a deployment measures again on the axis")
    torque_nm: float | None = Field(None, gt=0.0, description="the drive's torque that the trials took for granted")
    torque_rate_nm_per_s: float | None = Field(None, gt=0.0, description="slowest limit of the rate that they stood")

    @model_validator(mode="after")
    def _valid_means_checked(self) -> Certificate:
        if self.valid and not (self.checks and all(check.passed and check.margin >= 0.0 for check in self.checks)):
            raise ValueError("valid: true only with a list of checks that all passed, each with its margin")
        return self


class GainSet(Strict):
    """One gain set: the file model. `parameters.law` chooses the control law and with it the allowed keys."""

    schema_version: Literal[1]
    name: GainName
    description: str = Field("", max_length=1000)
    parameters: Parameters
    provenance: Provenance
    design: Design | None = Field(None, description="what the set was designed for, with its proofs")
    certificate: Certificate | None = None
    seal: Sha256 | None = Field(None, description="hash of all the rest, written by the tool that wrote the set")
    signature: GainSignature | None = Field(None, description="of the site, over all the rest but the seal")

    @property
    def law(self) -> Law:
        """The control law that the set is for."""
        return LAWS[self.parameters.law]

    def pack(self) -> tuple[float, ...]:
        """Flat parameters for the law's step, all finite, in the order that the law's module states."""
        return self.parameters.pack()

    def parameters_sha256(self) -> str:
        """Hash of law and parameters in canonical form: JSON, sorted keys, no blanks, shortest exact numbers.

        Defaults are written out, so that a changed default changes the hash; comments and notes do not. A key that is
        not there counts as none, so that an optional key of a later version leaves the hash as it is.
        """
        return _digest(self.parameters.model_dump(mode="json", exclude_none=True))

    def content_sha256(self) -> str:
        """Hash of the whole set but its seal and signature, in the same canonical form."""
        return _digest(self.model_dump(mode="json", exclude={"seal", "signature"}, exclude_none=True))

    def sealed(self) -> GainSet:
        """The same set with a seal that fits: every later change of a number shows."""
        return self.model_copy(update={"seal": self.content_sha256()})

    @property
    def seal_broken(self) -> bool:
        """Whether the set has a seal that does not fit, or a design without one."""
        return seal_fault(self) is not None

    def certificate_problem(self) -> str | None:
        """Why the set does not count as certified, in a few words; None when it does."""
        fault = certificate_fault(self)
        return None if fault is None else fault.problem

    def certificate_warning(self) -> str | None:
        """What to know of a certificate that counts: other checks than this version's issued it. None when there is
        nothing, or when the certificate does not say.
        """
        issued = self.certificate.tool_sha256 if self.certificate else None
        if issued in (None, source_sha256(VERIFIES)):
            return None
        return "its certificate is from another version of the checks; `servoctl verify` issues it again"

    def to_yaml(self) -> str:
        """The set as YAML text that `parse_gains` reads back to an equal set."""
        plain = self.model_dump(mode="json", exclude_none=True)
        return yaml.dump(plain, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=120)


def _digest(value: Any) -> str:
    plain = json.dumps(_all_floats(value), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(plain.encode()).hexdigest()


def _all_floats(value: Any) -> Any:
    """`value` with every number as a float, so that 1 and 1.0 hash alike."""
    if isinstance(value, dict):
        return {key: _all_floats(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_all_floats(item) for item in value]
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else value


def parse_gains(text: str, where: str) -> GainSet:
    """Check the YAML text of a gain set; `where` names it in errors. Raises BadInput (key, found, allowed)."""
    document = parse_yaml(text, where)
    require_kind(document, FileKind.GAINS, where)
    return validate(document, GainSet, where)


def load_gains(path: str | Path) -> GainSet:
    """Read and check a gain-set file. Raises BadInput (file and key, found, allowed)."""
    return parse_gains(read_text(path), str(path))


def require_certificate(gains: GainSet, accept_uncertified: bool | None, where: str | None = None) -> None:
    """Refuse a set without a valid certificate. Raises BadInput.

    `accept_uncertified` lets a set pass that carries no certificate at all; one whose certificate says no or is for
    other numbers, or whose seal is broken, never passes. None: there is no configuration that could accept it. `where`
    is the file, when there is one.
    """
    fault = certificate_fault(gains)
    if fault is None:
        return
    key = f"{where or 'gain set ' + gains.name}: {fault.key}"
    never = gains.certificate is not None or gains.seal_broken or accept_uncertified is None
    if never or not accept_uncertified:
        otherwise = "" if never else ", or gains.accept_uncertified: true in the configuration"
        raise BadInput(key, fault.problem, fault.remedy + otherwise)


def require_fit(gains: GainSet, config: AxisConfig, where: str | None = None) -> None:
    """Refuse a set that this axis may not run: no certificate that counts, or one for another cycle or velocity filter.

    Raises BadInput; `where` is the file, when there is one. The configuration may accept sets without a certificate,
    but not one of another loop, nor one without the signature that it asks for.
    """
    require_certificate(gains, config.gains.accept_uncertified, where)
    require_signed(gains, config, where)
    require_same_loop(gains, config, where)


def require_signed(gains: GainSet, config: AxisConfig, where: str | None = None) -> None:
    """Refuse a set that no signer of the configuration has signed, where it names any. Raises BadInput."""
    content = gains.content_sha256() if config.gains.signers else ""
    require_signature(content, gains.signature, config.gains.signers, where or f"gain set {gains.name}")


def require_same_loop(gains: GainSet, config: AxisConfig, where: str | None = None) -> None:
    """Refuse a set whose design is for another cycle, filter, encoder, torque, rate or delay than the axis has.

    What was certified is the sampled loop with its delay and its filter; with others the proof says nothing. A finer
    encoder, more torque, a faster change of it and less delay are no worse. What a set or a configuration does not
    state is not compared.
    Raises BadInput; `where` is the file, when there is one.
    """
    if gains.design is None:
        return
    design, cutoff_hz, where = gains.design, config.encoder.velocity_cutoff_hz, where or f"gain set {gains.name}"
    period_s = config.cycle.period_us * NS_PER_US / NS_PER_S
    same = {"velocity_cutoff_hz": (design.velocity_cutoff_hz, cutoff_hz), "period_s": (design.period_s, period_s)}
    for key, (wanted, found) in same.items():
        if not math.isclose(wanted, found, rel_tol=1e-6):
            raise BadInput(f"{where}: design.{key}", wanted, f"{found}, as the axis is configured")
    for key, wanted, found in _no_more(gains, design, config):
        if wanted > found * (1.0 + 1e-6):
            raise BadInput(f"{where}: {key}", wanted, f"at most {found:g}, as the axis is configured")
    _require_delay(where, design, config)
    require_devices(gains, devices_of(config), config, where)


def devices_of(config: AxisConfig) -> Devices:
    """Drive and encoder as far as the configuration states them; the daemon starts with no others."""
    amplifier, encoder = config.amplifier.identity.model_dump(), config.encoder.identity.model_dump()
    return Devices.of({"amplifier": amplifier, "encoder": encoder})


def require_devices(gains: GainSet, devices: Devices, config: AxisConfig, where: str | None = None) -> None:
    """Refuse a set whose model was identified with another drive or encoder than these.

    Another of the same type has other friction behind it, another torque constant and another zero. What one of both
    does not say is not compared. A configuration that accepts sets without a certificate accepts these, at its owner's
    word. Raises BadInput; `where` is the file, when there is one.
    """
    if not config.gains.accept_uncertified and (error := of_others(gains, devices, where)):
        raise error


def of_others(gains: GainSet, devices: Devices, where: str | None = None) -> BadInput | None:
    """What says that a set's model was identified with another drive or encoder; None where nothing does."""
    known = gains.design.model.identified if gains.design is not None else None
    if known is None or known.devices is None or not (found := known.devices.differing(devices)):
        return None
    key, own, other = found
    return BadInput(
        f"{where or f'gain set {gains.name}'}: design.model.identified.devices.{key}",
        own,
        f"{other}, as the axis has it; identify this axis and make a set of that, or set gains.accept_uncertified",
    )


def _no_more(gains: GainSet, design: Design, config: AxisConfig) -> Iterator[tuple[str, float, float]]:
    """Key, what the set takes for granted, and what the axis has of it; an encoder without counts has no steps."""
    yield "design.counts_per_turn", design.counts_per_turn, config.encoder.counts_per_turn
    certificate, limits = gains.certificate, config.limits
    if certificate is not None and certificate.torque_nm is not None:
        yield "certificate.torque_nm", certificate.torque_nm, limits.torque_nm
    if certificate is not None and certificate.torque_rate_nm_per_s is not None:
        yield "certificate.torque_rate_nm_per_s", certificate.torque_rate_nm_per_s, limits.torque_rate_nm_per_s


def _require_delay(where: str, design: Design, config: AxisConfig) -> None:
    """Refuse a set for less delay than the axis's model has; that model is the data sheet's, and so only about right.

    A client that was told the configuration by the daemon may not have the file; the daemon itself has.
    """
    if config.model is None or not config.model.is_file():
        return
    found = load_axis_model(config.model).total_delay_s
    most = design.model.total_delay_s + max(design.uncertainty.delay_s, DELAY_SHARE * design.period_s)
    if found > most:
        raise BadInput(
            f"{where}: design.model.delay_s",
            design.model.total_delay_s,
            f"{found:g}, as in {config.model}",
        )


def pd_set(
    name: str, position_nm_per_rad: float, velocity_nms_per_rad: float, tool: str = "servoctl deploy"
) -> GainSet:
    """A PD gain set made by a tool, without a design."""
    parameters = PdParameters(
        law="pd",
        position_gain_nm_per_rad=position_nm_per_rad,
        velocity_gain_nms_per_rad=velocity_nms_per_rad,
        feedforward_inertia_kg_m2=0.0,
    )
    source = Provenance(author="servod", date=datetime.datetime.now(tz=datetime.UTC).date(), tool=tool)
    return GainSet(schema_version=1, name=name, parameters=parameters, provenance=source)
