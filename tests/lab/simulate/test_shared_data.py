"""Independent witnesses: real and simulated recordings made by other people, when their folder is beside the project.

Without the folder this file holds no tests; the head of every test run says whether it is there. EMPS: the published
model gives the published error. Practice cases: with the concealed physics written into the model, the replay error
falls to what noise and quantisation leave.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from servod.common.yaml import parse_yaml
from servod.formats.model.axis_model import AxisModel, load_axis_model
from servod.lab.recordings import load_recording
from servod.lab.simulate.motion import Start
from servod.lab.simulate.replay import replay

SHARED = Path(__file__).parents[4] / "shared"
EMPS_FOLDER = SHARED / "recordings" / "emps"

EMPS = {
    "axis": "linear",
    "inertia": 95.11,
    "delay_s": 0.0,
    "friction": {"kind": "coulomb_viscous", "viscous": 203.5, "coulomb": 20.39},
    "torque_offset": 3.16,  # published as an offset of -3.16 N on the friction's side
}
MAP = "columns: {t_s: t, force_n: {from: vir, scale: 35.1507}, position_m: qm, reference_m: qg}\n"

#: Practice case -> largest share of the believed model's 50 ms error that the true model may leave. The three healthy
#: or nearly healthy cases are held to an absolute figure instead.
SHARES = {"p02": 0.02, "p03": 0.10, "p04": 0.03, "p06": 0.01, "p08": 0.03, "p10": 0.03, "p11": 0.05}
ABSOLUTE_RAD = {"p00": 7e-5, "p01": 5e-5, "p05": 1.2e-4, "p07": 7e-5, "p09": 4e-4}


def true_model(truth: dict[str, Any]) -> AxisModel:
    """The generator's own parameters as an axis model; its `backlash` is half the gap, its `asym` moves both ways."""
    q, two = truth["params"], "two_mass" in truth["params"]
    model: dict[str, Any] = {
        "inertia": q["inertia"] + q.get("load_inertia", 0.0),
        "delay_s": 1e-3 * truth["opts"].get("delay_steps", 1.0),
        "friction": {
            **{key: q[key] for key in ("sigma0", "sigma1", "coulomb", "static")},
            **{"kind": "lugre", "stribeck_velocity": q["vs"], "viscous": q["viscous"] + q.get("load_viscous", 0.0)},
        },
        "gravity": {"amplitude": q.get("grav_amp", 0.0), "phase": q.get("grav_phase", 0.0)},
    }
    if "asym" in q:
        model["asymmetry"] = {"positive_dry": 2.0 - q["asym"], "negative_dry": q["asym"]}
    if "cog_amp" in q:
        sines = [(q["cog_amp"], q["cog_n"]), (q["cog2_amp"], 2.0 * q["cog_n"])]
        model["cogging"] = {
            "harmonics": [{"amplitude": a, "periods_per_turn": n, "phase": q["cog_phase"]} for a, n in sines]
        }
    if "therm_visc" in q:
        model["thermal"] = {"dry_per_c": -q["therm_coul"], "viscous_per_c": -q["therm_visc"]}
    if two:
        behind = {key: q[key] for key in ("load_inertia", "stiffness", "damping", "load_viscous")}
        gap = q.get("backlash")
        model["backlash" if gap else "joint_elasticity"] = {**behind, "gap": 2.0 * gap} if gap else behind
    return AxisModel.model_validate(model)


#: Published errors, mm: windows restarted from the recorded motion, and a free run from rest. An integrator written
#: apart from this project (50 us steps, central differences for the restarts) gives 0.193, 1.566, 0.257, 2.22 and 9.43
#: for these rows, with the force held, averaged or shifted by a sample within 4 % of that; how the published restarts
#: were smoothed is not said. Each tolerance is what separates that integrator from the published figure.
EMPS_FIGURES = [
    ("DATA_EMPS", 0.25, Start.AUTO, 0.183, 0.06),
    ("DATA_EMPS", 1.0, Start.AUTO, 1.55, 0.015),
    ("DATA_EMPS_PULSES", 0.25, Start.AUTO, 0.244, 0.06),
    ("DATA_EMPS_PULSES", 1.0, Start.AUTO, 2.19, 0.015),
    ("DATA_EMPS_PULSES", None, Start.REST, 9.2, 0.03),
    ("DATA_EMPS_PULSES", None, Start.AUTO, 9.2, 0.03),
]

if EMPS_FOLDER.is_dir():

    @pytest.mark.parametrize("file, horizon_s, start, rms_mm, share", EMPS_FIGURES)
    def test_published_model_gives_the_published_error(
        file: str, horizon_s: float | None, start: Start, rms_mm: float, share: float, tmp_path: Path
    ) -> None:
        column_map = tmp_path / "map.yaml"
        column_map.write_text(MAP)
        recording = load_recording(EMPS_FOLDER / f"{file}.mat", column_map)
        result = replay(AxisModel.model_validate(EMPS), recording.drive, horizon_s, start=start)
        assert 1e3 * result.rms == pytest.approx(rms_mm, rel=share)


if (SHARED / "recordings" / "bam_xl330").is_dir():

    def test_uneven_recording_with_glitches_reads_and_replays(tmp_path: Path) -> None:
        column_map = tmp_path / "map.yaml"
        column_map.write_text("columns: {torque_nm: {from: voltage_command_v, scale: 0.06}}\n")
        recording = load_recording(SHARED / "recordings" / "bam_xl330" / "sin_sin_kp100.csv.gz", column_map)
        assert any("load_raw" in line for line in recording.report)
        friction = {"kind": "coulomb_viscous", "coulomb": 0.05, "viscous": 0.05}
        pendulum = {"inertia": 0.005, "friction": friction, "gravity": {"amplitude": 0.48}}
        result = replay(AxisModel.model_validate(pendulum), recording.drive, 0.1)
        assert len(result.position) == len(recording)
        assert result.rms < 0.1


if (SHARED / "practice").is_dir():

    @pytest.mark.parametrize("case", sorted({*SHARES, *ABSOLUTE_RAD}))
    def test_the_concealed_physics_explains_the_recording(case: str) -> None:
        folder = SHARED / "practice" / case
        recording = load_recording(folder / "holdout.csv.gz")
        truth = parse_yaml((folder / "truth.yaml").read_text(), "truth.yaml")
        left = replay(true_model(truth), recording.drive, 0.05).rms
        if case in ABSOLUTE_RAD:
            assert left < ABSOLUTE_RAD[case]
        else:
            assert left < SHARES[case] * replay(load_axis_model(folder / "model.yaml"), recording.drive, 0.05).rms
