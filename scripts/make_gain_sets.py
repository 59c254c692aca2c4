"""Makes the gain sets that ship in gains/: the paper's, and those of the demo joint. Run it after changing a number.

The paper's sets are Table I read as the project reads it. The demo sets stand for an identification and a tuning on
the demo joint: its steady friction at the nodes, each value with an error of a few per cent, without cogging,
warming and noise, which the map cannot hold. With `--check` nothing is written; exit code 1 when a file is stale.

`--certified` makes the last set, demo_local_certified, and the identified model that it is of, by the product's own
commands in two minutes: `servoctl identify` on a virtual axis that is the demo joint, `servoctl synthesize` for the
demo's velocity filter, `servoctl verify` with its full number of plants. Run it after changing the joint or the file
formats; a certificate of an earlier version of the checks stays valid, and says of itself which version that was.
"""

from __future__ import annotations

import argparse
import datetime
import hashlib
import math
import random
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from servod.common.files import write_atomically
from servod.common.yaml import validate
from servod.formats.config import EncoderConfig
from servod.formats.gains.gain_set import GainSet, load_gains
from servod.formats.model.axis_model import AxisModel, LugreFriction, load_axis_model

GAINS = Path(__file__).resolve().parent.parent / "gains"
AXES = GAINS / "axes"
MADE = "# Made by scripts/make_gain_sets.py.\n"
MADE_CERTIFIED = "# Made by scripts/make_gain_sets.py --certified.\n"
#: The set that is certified, the model that it is of, and the plant that this was identified on.
CERTIFIED = GAINS / "demo_local_certified.yaml"
IDENTIFIED, PLANT = AXES / "demo_joint_identified.yaml", AXES / "demo_joint.yaml"
DATE = datetime.date(2026, 11, 23).isoformat()
MAP_ERROR, MAP_SEED = 0.03, 3

#: c0_hat as a share of sigma0: up to 0.8 is stable with one to three cycles of delay, 1.0 is marginal.
STIFFNESS_SHARE = 0.8
PAPER_NODES = (-0.5, -0.2, -0.01, -0.001, 0.0, 0.001, 0.05, 0.12, 0.5)
PRINTED_K_I = (0.0, 0.0, -0.5, -1.5, -2.5, -1.5, 0.5, 0.0, 0.0)
#: Printed K_i times this, all positive: the sign that helps, the size that is stable.
K_I_SCALE = 0.02
_POSITIVE = (0.001, 0.002, 0.005, 0.01, 0.02, 0.035, 0.05, 0.08, 0.12, 0.2, 0.5)
DEMO_NODES = (*(-v for v in reversed(_POSITIVE)), 0.0, *_POSITIVE)

PD = {"position_gain_nm_per_rad": 2.5, "velocity_gain_nms_per_rad": 0.12}
#: The paper's PD gains as gains of the local law, K = 0.1.
EQUAL_FEEDBACK = {"k_x_per_rad": 25.0, "k_v_s_per_rad": 1.2}
DOB = {"bandwidth_rad_s": 50.0, "inertia_kg_m2": 0.001, "disturbance_limit_nm": 0.1}
LUGRE = {
    "stiffness_nm_per_rad": 950.0,
    "damping_nms_per_rad": 1.0,
    "viscous_nms_per_rad": 0.056,
    "coulomb_nm": 0.045,
    "static_nm": 0.07,
    "stribeck_velocity_rad_s": 0.1,
    "friction_limit_nm": 0.12,
}
HOLD = {"hold_within_rad": 2e-5}
REGIONS_TABLE1 = {
    "low": {"k_z_per_rad": 0.017, "k_v_s_per_rad": 0.241, "k_x_per_rad": 1574.9},
    "high": {"k_z_per_rad": 21.615, "k_v_s_per_rad": 2.104, "k_x_per_rad": 197.0},
}
REGIONS_TABLE1_OTHER = {
    "low": {"k_x_per_rad": 0.017, "k_v_s_per_rad": 0.241, "k_z_per_rad": 1574.9},
    "high": {"k_x_per_rad": 21.615, "k_v_s_per_rad": 2.104, "k_z_per_rad": 197.0},
}
REGIONS_EQUAL = {"low": EQUAL_FEEDBACK, "high": EQUAL_FEEDBACK}
OVERLAP = {"overlap_from_rad_s": 0.005, "overlap_to_rad_s": 0.02}


def stribeck(friction: LugreFriction, v: float) -> float:
    """g(v) of (18), in N*m."""
    static = friction.coulomb if friction.static is None else friction.static
    return friction.coulomb + (static - friction.coulomb) * math.exp(-((v / friction.stribeck_velocity) ** 2))


def steady_friction(model: AxisModel, v: float) -> float:
    """Magnitude of the joint's friction at constant velocity, direction by direction, in N*m."""
    assert isinstance(model.friction, LugreFriction)
    dry, viscous = 1.0, 1.0
    if model.asymmetry:
        a = model.asymmetry
        dry, viscous = (a.positive_dry, a.positive_viscous) if v > 0.0 else (a.negative_dry, a.negative_viscous)
    return dry * stribeck(model.friction, v) + viscous * model.friction.viscous * abs(v)


def friction_map(model: AxisModel, nodes: tuple[float, ...], error: float) -> dict[float, float]:
    """Friction torque at each node but zero, with a relative error from a seeded normal distribution."""
    random_error = random.Random(MAP_SEED)  # noqa: S311  (a measurement error, no secret)
    return {v: steady_friction(model, v) * (1.0 + random_error.gauss(0.0, error)) for v in nodes if v != 0.0}


def local_friction(friction: dict[float, float], gain: Callable[[int], float], **options: Any) -> dict[str, Any]:
    """The sets: a_i = c0*|v_i| / (F_i - d0*|v_i|) by (7), a = 0 at rest by (6); `gain` gives l_i by index."""
    c0, d0 = STIFFNESS_SHARE * LUGRE["stiffness_nm_per_rad"], LUGRE["viscous_nms_per_rad"]
    decays = {v: c0 * abs(v) / (torque - d0 * abs(v)) for v, torque in friction.items()} | {0.0: 0.0}
    sets = [
        {"velocity_rad_s": v, "decay_per_s": round(decays[v], 3), "gain": gain(i)} for i, v in enumerate(sorted(decays))
    ]
    limit = LUGRE["friction_limit_nm"]
    return {"stiffness_nm_per_rad": c0, "viscous_nms_per_rad": d0, "friction_limit_nm": limit, **options, "sets": sets}


def gain_set(
    name: str, description: str, parameters: dict[str, Any], model_file: str, note: str, seed: int | None = None
) -> GainSet:
    """A checked gain set with its provenance."""
    provenance = {
        "author": "servod",
        "date": DATE,
        "tool": "scripts/make_gain_sets.py",
        "model_sha256": hashlib.sha256((GAINS / "axes" / model_file).read_bytes()).hexdigest(),
        "seed": seed,
        "note": note,
    }
    data = {"schema_version": 1, "name": name, "description": description, "parameters": parameters}
    return validate(data | {"provenance": provenance}, GainSet, name)


def paper_sets() -> list[GainSet]:
    """PD, PD + DOB and PD + LuGre with the paper's numbers."""

    def paper(name: str, description: str, parameters: dict[str, Any], note: str) -> GainSet:
        """A set on the paper's joint."""
        return gain_set(name, description, parameters, "table1_joint.yaml", note)

    lugre = {"law": "pd_lugre", **PD, **LUGRE}
    scale = "u* = u_feedback/K with K = 0.1, as in (9)."
    return [
        paper("paper_pd", "The paper's PD gains.", {"law": "pd", **PD}, "K_P and K_D of Table I."),
        paper(
            "paper_pd_dob",
            "The paper's PD gains with a disturbance observer.",
            {"law": "pd_dob", **PD, **DOB},
            "The paper does not print the observer's bandwidth; 50 rad/s comes near its RMS error.",
        ),
        paper("paper_pd_lugre", "PD with the LuGre observer of Table I, l_f = 0.", lugre, scale),
        paper(
            "paper_pd_lugre_lf025",
            "PD with the LuGre observer of Table I, l_f = 0.25: the paper's better value at 10 mrad.",
            lugre | {"observer_gain": 0.25},
            scale,
        ),
        paper(
            "paper_pd_lugre_lf035",
            "PD with the LuGre observer of Table I, l_f = 0.35: oscillates at 10 mrad.",
            lugre | {"observer_gain": 0.35},
            scale,
        ),
    ]


def table1_sets(model: AxisModel) -> list[GainSet]:
    """The local law of Table I in both readings of the printed gain labels "K_v, K_v, K_z"."""
    friction = local_friction(friction_map(model, PAPER_NODES, 0.0), lambda i: K_I_SCALE * abs(PRINTED_K_I[i]))
    note = (
        "Nodes and gains of Table I; a_i by (7) from its friction, c0_hat 0.8 of sigma0. l_i is the printed K_i times "
        f"{K_I_SCALE}, positive: at the printed size and sign it does worse than none. Overlap of the regions chosen."
    )

    def local(name: str, description: str, regions: dict[str, Any]) -> GainSet:
        """Table I's local sets with the feedback of these regions."""
        parameters = {"law": "local", "regions": regions | OVERLAP, "friction": friction}
        return gain_set(name, description, parameters, "table1_joint.yaml", note)

    return [
        local("table1_kz_kv_kx", "Table I read as (K_z, K_v, K_x): the reading that tracks.", REGIONS_TABLE1),
        local(
            "table1_kx_kv_kz",
            "Table I read as (K_x, K_v, K_z): hardly any position feedback, the axis hardly moves.",
            REGIONS_TABLE1_OTHER,
        ),
    ]


def demo_rivals() -> list[GainSet]:
    """What the demo compares the local law with, all with the paper's PD gains."""

    def demo(name: str, description: str, parameters: dict[str, Any], note: str) -> GainSet:
        """A set on the demo joint."""
        return gain_set(name, description, parameters, "demo_joint.yaml", note)

    observer = {"stiffness_nm_per_rad": STIFFNESS_SHARE * LUGRE["stiffness_nm_per_rad"], "observer_gain": 0.2}
    return [
        demo("demo_pd", "PD with the paper's gains.", {"law": "pd", **PD}, "K_P and K_D of Table I."),
        demo(
            "demo_pd_dob",
            "PD with a disturbance observer of 50 rad/s.",
            {"law": "pd_dob", **PD, **DOB, **HOLD},
            "The hold width keeps observer and stiction from hunting at rest.",
        ),
        demo(
            "demo_pd_lugre",
            "PD with a LuGre observer: one friction curve for both directions.",
            {"law": "pd_lugre", **PD, **LUGRE, **observer, **HOLD},
            "Friction is the mean of both directions, all that this law can hold. l_f 0.2: less tracks worse, more "
            "makes the torque rough (5 mN*m from cycle to cycle at 0.25).",
        ),
    ]


def demo_local_sets(model: AxisModel) -> list[GainSet]:
    """The local law on the demo joint, from equal feedback to the gains of Table I."""
    measured = friction_map(model, DEMO_NODES, MAP_ERROR)
    table = ", ".join(f"{v:g}: {math.copysign(torque, v) * 1e3:.2f}" for v, torque in sorted(measured.items()))
    note = (
        f"Friction map [rad/s: mN*m], the joint's steady friction per direction with {MAP_ERROR:.0%} random error "
        f"(seed {MAP_SEED}), standing for an identified one; cogging, warming and noise are not in it: {table}. "
        "c0_hat 0.8 of sigma0, stable with one to three cycles of delay."
    )
    reference = {"velocity": "reference"}

    def local(name: str, description: str, gain: float, regions: dict[str, Any], **options: Any) -> GainSet:
        """The measured friction with one l_i for all sets; `options` are further keys, `friction` those of the map."""
        friction = local_friction(measured, lambda i: gain, **options.pop("friction", {}))
        parameters = {"law": "local", "regions": regions | OVERLAP, "friction": friction, **options, **HOLD}
        return gain_set(name, description, parameters, "demo_joint.yaml", note, MAP_SEED)

    return [
        local(
            "demo_local",
            "Local law at the paper's PD gains, with the reference's velocity in the friction state and the same "
            "disturbance observer as demo_pd_dob: equal feedback, for comparison.",
            0.04,
            REGIONS_EQUAL,
            friction=reference,
            disturbance_observer=DOB,
        ),
        local(
            "demo_local_plain",
            "Local law (9), (16) at the paper's PD gains, measured velocity, without any option.",
            0.1,
            REGIONS_EQUAL,
        ),
        local(
            "demo_local_no_observer",
            "demo_local without its disturbance observer: friction map and reference velocity alone.",
            0.04,
            REGIONS_EQUAL,
            friction=reference,
        ),
        local(
            "demo_local_measured",
            "demo_local with the measured velocity in place of the reference's.",
            0.04,
            REGIONS_EQUAL,
            disturbance_observer=DOB,
        ),
        local(
            "demo_local_stiff",
            "Local law with the gains of Table I, the reference's velocity and the disturbance observer: tracks best.",
            0.04,
            REGIONS_TABLE1,
            friction=reference,
            disturbance_observer=DOB,
        ),
    ]


def all_sets() -> list[GainSet]:
    """Every gain set that ships."""
    table1 = load_axis_model(GAINS / "axes" / "table1_joint.yaml")
    demo = load_axis_model(GAINS / "axes" / "demo_joint.yaml")
    return [*paper_sets(), *table1_sets(table1), *demo_rivals(), *demo_local_sets(demo)]


def servoctl(*words: str) -> None:
    """Run one command of the product; its exit code ends this program when it is not 0."""
    print("servoctl", *words, flush=True)
    subprocess.run([sys.executable, "-m", "servod.cli", *words], check=True, stdout=subprocess.DEVNULL)


def sha256(file: Path) -> str:
    """Hash of a file."""
    return hashlib.sha256(file.read_bytes()).hexdigest()


def identified_text(model: str) -> str:
    """The identified model as it ships: what it was identified on, so that a changed plant shows."""
    return (
        f"{MADE_CERTIFIED[:-2]}: what `servoctl identify` finds of demo_joint.yaml, each value with\n"
        f"# its 95 % interval. That plant's hash: {sha256(PLANT)}\n{model}"
    )


def certify() -> None:
    """Identify the demo joint, synthesize for what was found, verify, and keep model and certified set."""
    with tempfile.TemporaryDirectory(prefix="servod-gains-") as name:
        model, gains = Path(name) / "model.yaml", Path(name) / "gains.yaml"
        servoctl("identify", "--plant", str(PLANT), "--out", str(model))
        write_atomically(IDENTIFIED, identified_text(model.read_text(encoding="utf-8")))
        cutoff = f"{EncoderConfig().velocity_cutoff_hz:g}"  # the demo's axis has the filter that is the default
        servoctl(
            *("synthesize", "--model", str(IDENTIFIED), "--out", str(gains), "--name", CERTIFIED.stem),
            *("--cutoff-hz", cutoff),
        )
        servoctl("verify", str(gains))
        write_atomically(CERTIFIED, MADE_CERTIFIED + gains.read_text(encoding="utf-8"))


def certified_problem() -> str | None:
    """Why the certified set must be made again; None when it is certified, for this model and this plant."""
    if not CERTIFIED.exists() or not IDENTIFIED.exists():
        return "missing"
    gains = load_gains(CERTIFIED)
    if problem := gains.certificate_problem():
        return problem
    if gains.provenance.model_sha256 != sha256(IDENTIFIED):
        return f"of another model than {IDENTIFIED.name}"
    if sha256(PLANT) not in IDENTIFIED.read_text(encoding="utf-8"):
        return f"identified on another {PLANT.name}"
    return None


def main() -> int:
    """Write the files, or compare them with `--check`."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing, exit 1 when a file is stale")
    parser.add_argument("--certified", action="store_true", help=f"make {CERTIFIED.stem} again as well, in two minutes")
    options = parser.parse_args()
    check = options.check
    if options.certified and not check:
        certify()
    stale = 0
    if problem := certified_problem():
        stale += 1
        print(f"{CERTIFIED.name}: {problem}; --certified makes it")
    for gains in all_sets():
        path, text = GAINS / f"{gains.name}.yaml", f"{MADE}{gains.to_yaml()}"
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            stale += 1
            print(f"{path.name}: {'stale' if check else 'written'}")
            if not check:
                write_atomically(path, text)
    return 1 if stale and (check or problem) else 0


if __name__ == "__main__":
    sys.exit(main())
