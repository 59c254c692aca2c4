"""The paper's numbers beside ours, made from the JSON document of a run, so that anyone can print them again.

Stands on plain values. The manual quotes `numbers`; `QUANTITIES` is its first column, by which a test knows its form.
"""

from __future__ import annotations

from typing import Any

from servod.lab.report.figure import PageTable
from servod.qualify.paper.joints import PaperJoint
from servod.qualify.paper.printed import FRICTION, GAINS_HIGH, GAINS_LOW, INERTIA
from servod.qualify.paper.results import Row

_GAIN = 0.1  # K of Table I
#: Identified values beside Table I: (quantity, key of the identification, digits' unit factor, value of Table I).
_IDENTIFIED: tuple[tuple[str, str, float, float], ...] = (
    ("σ0 / N·m/rad", "sigma0", 1.0, FRICTION.sigma0),
    ("σ1 / N·m·s/rad", "sigma1", 1.0, FRICTION.sigma1),
    ("m / g·m²", "inertia", 1e3, 1e3 * INERTIA),
    *(
        (f"{symbol} {sign} / {unit}", f"{key}_{side}", factor, factor * value)
        for symbol, key, unit, factor, value in (
            ("F_S", "static", "mN·m", 1e3, FRICTION.static),
            ("F_C", "coulomb", "mN·m", 1e3, FRICTION.coulomb),
            ("F_V", "viscous", "mN·m·s/rad", 1e3, FRICTION.viscous),
            ("v_s", "stribeck_velocity", "rad/s", 1.0, FRICTION.stribeck_velocity),
        )
        for sign, side in (("+", "positive"), ("−", "negative"))
    ),
)
#: Feedback beside Table I read as (K_z, K_v, K_x): (quantity, region, key in the document, value of Table I).
_FEEDBACK: tuple[tuple[str, str, str, float], ...] = (
    ("K·K_x in Ω_L / N·m/rad", "low", "position_nm_per_rad", _GAIN * GAINS_LOW.third),
    ("K·K_v in Ω_L / N·m·s/rad", "low", "velocity_nms_per_rad", _GAIN * GAINS_LOW.second),
    ("K·K_x in Ω_H / N·m/rad", "high", "position_nm_per_rad", _GAIN * GAINS_HIGH.third),
    ("K·K_v in Ω_H / N·m·s/rad", "high", "velocity_nms_per_rad", _GAIN * GAINS_HIGH.second),
)
#: Class of a law that was synthesized and not tuned.
UNLIMITED = "own, roughness not limited"
_RMS = "RMS on (19) / mrad: "

#: First column of the table, in order.
QUANTITIES: tuple[str, ...] = (
    *(_RMS + row.label for row in Row),
    *(quantity for quantity, *_ in _IDENTIFIED),
    *(quantity for quantity, *_ in _FEEDBACK),
)


def numbers(document: dict[str, Any]) -> PageTable:
    """Every number that the paper prints beside ours on each joint, and the RMS errors of all rows."""
    joints = [PaperJoint(name) for name in document["joints"]]
    header = ("quantity", "paper", *(joint.label for joint in joints))
    rows = [
        (_RMS + row.label, "" if row.paper_mrad is None else f"{row.paper_mrad:g}", *_cells(document, joints, row))
        for row in Row
    ]
    for quantity, key, factor, printed in _IDENTIFIED:
        found = (document["joints"][joint.value]["identified"] for joint in joints)
        rows.append((quantity, f"{printed:g}", *(_interval(values.get(key), factor) for values in found)))
    for quantity, region, key, printed in _FEEDBACK:
        found = (document["joints"][joint.value]["feedback"] for joint in joints)
        rows.append((quantity, f"{printed:.4g}", *(f"{values[region][key]:.4g}" for values in found)))
    return PageTable("The paper's numbers beside ours", header, tuple(rows))


def _cells(document: dict[str, Any], joints: list[PaperJoint], row: Row) -> list[str]:
    cells = []
    for joint in joints:
        found = document["joints"][joint.value]["tracking"][row.name.lower()]
        cells.append(
            "stopped: " + found["stops"]["(19)"]
            if found["rms_error_mrad"] is None
            else f"{found['rms_error_mrad']:.4f}"
        )
    return cells


def _interval(found: dict[str, Any] | None, factor: float) -> str:
    """A value with its 95 % interval; a dash where it was not identified."""
    if found is None:
        return "–"
    value, low, high = (factor * found[key] for key in ("value", "low", "high"))
    return f"{value:.4g} ({low:.4g} to {high:.4g})"


def steps(document: dict[str, Any], joint: PaperJoint) -> PageTable:
    """Settling, overshoot, steady error and what is held of every row's steps on one joint."""
    header = ("controller", *(f"{size} mrad: {what}" for size in ("100", "10") for what in _STEP))
    rows = []
    for row in Row:
        found = document["joints"][joint.value]["tracking"][row.name.lower()]
        cells = [cell for size in ("100", "10") for cell in _step(found, size)]
        rows.append((row.label, *cells))
    return PageTable(f"Steps on {joint.label}", header, tuple(rows))


_STEP = ("settles / ms", "overshoot", "steady error / mrad")


def _step(found: dict[str, Any], size: str) -> tuple[str, str, str]:
    response = found["steps"].get(size)
    if response is None:
        return found["stops"].get(f"{size} mrad", "–"), "–", "–"
    settled = "never" if response["settling_s"] is None else f"{1e3 * response['settling_s']:.0f}"
    return settled, f"{response['overshoot']:.1%}", f"{response['steady_error_mrad']:.3g}"


def tuned(document: dict[str, Any], joint: PaperJoint) -> PageTable:
    """The rivals after a fair tuning on one joint, by class; then the law as synthesized, of no limited roughness."""
    header = ("controller", "feedback", "RMS on (19) / mrad", "largest / mrad", "roughness / mN·m")
    found = document["joints"][joint.value]
    rows = [(r["law"], r["feedback"], *_tracked(r)) for r in found["tuned"]]
    rows.append((Row.DEPLOYED.label, UNLIMITED, *_tracked(found["tracking"][Row.DEPLOYED.name.lower()])))
    return PageTable(f"Rivals tuned by the same rules on {joint.label}", header, tuple(rows))


def _tracked(found: dict[str, Any]) -> tuple[str, str, str]:
    """Errors and roughness of one run; dashes where the axis stopped."""
    if found["rms_error_mrad"] is None:
        return "–", "–", "–"
    return f"{found['rms_error_mrad']:.4f}", f"{found['max_error_mrad']:.3f}", f"{1e3 * found['roughness_nm']:.3g}"


def claims(document: dict[str, Any]) -> PageTable:
    """Every claim by its figure, and whether it agrees."""
    rows = [
        (", ".join(filter(None, (figure["number"], figure["where"]))), claim["paper"], claim["here"], _verdict(claim))
        for figure in document["figures"]
        for claim in figure["claims"]
    ]
    rows += [(said["about"], said["paper"], said["here"], _verdict(said)) for said in document["statements"]]
    return PageTable("What agrees and what does not", ("figure", "the paper", "here", ""), tuple(rows))


def _verdict(claim: dict[str, Any]) -> str:
    return "agrees" if claim["agrees"] else "does not agree"


def quotation(document: dict[str, Any]) -> str:
    """What the manual quotes: the numbers, and the rivals where they were tuned, as paper.md has them."""
    joints = [PaperJoint(name) for name in document["joints"] if document["joints"][name]["tuned"]]
    return "\n\n".join(each.markdown() for each in (numbers(document), *(tuned(document, joint) for joint in joints)))
