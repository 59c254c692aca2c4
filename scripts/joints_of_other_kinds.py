"""Commission virtual joints of many kinds, and print what each came to: a table for docs/results.md.

Every kind is a plain joint with one thing else: more delay, a coarse encoder, a steep or a bent friction curve, strong
cogging, a spring, a lag of the drive, backlash, weight, another size. Each goes through `servoctl commission --plant`
as anybody's would; the table says whether it ended with a certified set, and what that one does on trajectory (19).

    python scripts/joints_of_other_kinds.py --out out/kinds --jobs 2
    python scripts/joints_of_other_kinds.py --out out/kinds --only delay2,bit17
"""

from __future__ import annotations

import argparse
import copy
import json
import math
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import yaml

from servod.common.shipped import shipped

#: The paper's joint with a flatter fall, friction that differs by direction, and noise.
PLAIN: dict[str, Any] = yaml.safe_load(shipped("gains/axes/table1_joint.yaml").read_text(encoding="utf-8"))
PLAIN["friction"]["static"] = 0.06
PLAIN["asymmetry"] = {"positive_dry": 1.1, "negative_dry": 0.9}
PLAIN["noise"] = {"torque_rms": 0.0003, "torque_bandwidth_hz": 200.0, "encoder_rms": 2e-6}
#: What is in torques, and grows with the size of a joint.
TORQUES = ("sigma0", "sigma1", "viscous", "coulomb", "static")


def spring(resonance_hz: float, load: float = 0.0005, damping_ratio: float = 0.02) -> dict[str, float]:
    """Half of the inertia behind a spring with this resonance."""
    reduced, w = load * (PLAIN["inertia"] - load) / PLAIN["inertia"], 2.0 * math.pi * resonance_hz
    return {"load_inertia": load, "stiffness": reduced * w * w, "damping": 2.0 * damping_ratio * w * reduced}


def larger(factor: float) -> dict[str, Any]:
    """The plain joint with all its torques so much larger."""
    friction = PLAIN["friction"] | {key: factor * PLAIN["friction"][key] for key in TORQUES}
    noise = PLAIN["noise"] | {"torque_rms": factor * PLAIN["noise"]["torque_rms"]}
    return {"inertia": factor * PLAIN["inertia"], "friction": friction, "noise": noise}


#: Kind: (what it is, what its model has beside the plain joint, counts a turn).
KINDS: dict[str, tuple[str, dict[str, Any], int | None]] = {
    "plain": ("one cycle of delay, 20 bit, F_S/F_C 1.33, asymmetry 20 %", {}, None),
    "delay2": ("two cycles of delay", {"delay_s": 0.002}, None),
    "delay3": ("three cycles of delay", {"delay_s": 0.003}, None),
    "bit17": ("17 bit", {}, 2**17),
    "bit17_delay2": ("17 bit, two cycles of delay", {"delay_s": 0.002}, 2**17),
    "steep": ("F_S/F_C 2", {"friction": {"static": 0.09}}, None),
    "exponent1": (
        "exponent 1, asymmetry 30 %",
        {"stribeck": {"exponent": 1.0}, "asymmetry": {"positive_dry": 1.15, "negative_dry": 0.85}},
        None,
    ),
    "cogging20": (
        "cogging of 20 mN·m",
        {"cogging": {"harmonics": [{"amplitude": 0.02, "periods_per_turn": 22, "phase": 0.7}]}},
        None,
    ),
    "lag150": ("lag of the drive, 150 Hz", {"actuator_lag": {"time_constant_s": 1.0 / (300.0 * math.pi)}}, None),
    "size100": ("100 times the size", larger(100.0), None),
    "weight_below": ("weight below friction, 30 mN·m", {"gravity": {"amplitude": 0.03}}, None),
    "weight_above": ("weight above friction, 120 mN·m", {"gravity": {"amplitude": 0.12, "phase": 0.5}}, None),
    "spring60": ("spring, 60 Hz", {"joint_elasticity": spring(60.0)}, None),
    "spring150": ("spring, 150 Hz", {"joint_elasticity": spring(150.0)}, None),
    "spring400": ("spring, 400 Hz", {"joint_elasticity": spring(400.0)}, None),
    "backlash": (
        "backlash of 1 mrad",
        {"backlash": {"gap": 0.001, "load_inertia": 0.0003, "stiffness": 400.0, "damping": 0.05}},
        None,
    ),
}


def model_of(more: dict[str, Any]) -> dict[str, Any]:
    """The plain joint with `more`; groups that it has already get single keys."""
    model = copy.deepcopy(PLAIN)
    for key, value in more.items():
        model[key] = model[key] | value if isinstance(value, dict) and key in model else value
    return model


def commissioned(kind: str, out: Path, limit_s: float) -> dict[str, Any]:
    """The document of `servoctl commission` for one kind; one that took too long says so."""
    _, more, counts = KINDS[kind]
    plant = out / f"{kind}.yaml"
    plant.write_text(yaml.safe_dump(model_of(more)))
    command = [
        str(Path(sys.executable).with_name("servoctl")),
        "commission",
        "--plant",
        str(plant),
        "--out",
        str(out / kind),
    ]
    command += ["--no-rivals", "--yes", "--processes", "1", "--json"]
    command += ["--encoder-counts", str(counts)] if counts else []
    try:
        ended = subprocess.run(command, capture_output=True, text=True, timeout=limit_s, check=False)
    except subprocess.TimeoutExpired:
        return {"failed": {"message": f"not ended after {limit_s:g} s"}}
    (out / f"{kind}.json").write_text(ended.stdout)
    try:
        return dict(json.loads(ended.stdout))
    except json.JSONDecodeError:
        return {"failed": {"message": f"exit code {ended.returncode}: {ended.stderr[-160:]}"}}


def row(kind: str, told: dict[str, Any]) -> str:
    """One line of the table."""
    what = KINDS[kind][0]
    if "tracking" not in told:
        why = (told.get("failed") or told["error"])["message"]
        return f"| {what} | no | - | - | - | - | {str(why).split(chr(10))[0][:160]} |"
    figures, certificate = told["tracking"]["local"], told["certificate"]
    refused = certificate["refused"]
    why = f"at the full weight: {'; '.join(refused[0]['failed'])}" if refused else ""
    return (
        f"| {what} | yes | {certificate['position_weight']:g} | {figures['rms_error_mrad']:.3f} | "
        f"{figures['max_error_mrad']:.3f} | {told['seconds']['total']:.0f} | {why} |"
    )


def main() -> None:
    """All kinds, or those of `--only`; the table in the order of KINDS."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder for the walks; one that exists is gone on in")
    parser.add_argument("--only", help="kinds, separated by commas", default=",".join(KINDS))
    parser.add_argument("--jobs", type=int, default=1, help="walks at once")
    parser.add_argument("--limit-s", type=float, default=1500.0, help="longest walk")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    asked = options.only.split(",")
    if unknown := sorted({*asked} - {*KINDS}):
        parser.error(f"--only: found {', '.join(unknown)}; allowed: {', '.join(KINDS)}")
    kinds = [kind for kind in KINDS if kind in asked]

    def walk(kind: str) -> dict[str, Any]:
        told = commissioned(kind, options.out, options.limit_s)
        print(row(kind, told), file=sys.stderr, flush=True)
        return told

    with ThreadPoolExecutor(options.jobs) as pool:
        rows = [row(kind, told) for kind, told in zip(kinds, pool.map(walk, kinds), strict=True)]
    print("| Joint | certified | weight | RMS, mrad | largest, mrad | s | |")
    print("| --- | --- | --- | --- | --- | --- | --- |", *rows, sep="\n")


if __name__ == "__main__":
    main()
