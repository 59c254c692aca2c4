"""Writes the cases of a trial: folders with a model and recordings, and apart from them the truth, sealed by its hash.

The first of the three processes. The hash is told before anybody diagnoses; the truth contains a random number, so that
nobody finds it by trying seeds. What is sealed cannot be read until it is scored, unless its owner allows it again.
"""

from __future__ import annotations

import gzip
import hashlib
import io
import json
import re
import secrets
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from servod import __version__
from servod.common.errors import BadInput
from servod.common.files import is_there, read_json, write_bytes
from servod.common.progress import OnCount
from servod.common.units import counted
from servod.qualify.blind import engine, listed
from servod.qualify.blind.axes import CaseAxis, draw_axis
from servod.qualify.blind.concealed import NO_THERMOMETER, Concealed, Document, Draw
from servod.qualify.blind.hidden import HIDE, UNLISTED
from servod.qualify.blind.physics import Physics
from servod.qualify.blind.plan import CaseSpec, Cover, Engine, Settings, Sort
from servod.qualify.blind.plant import Loop, rest, run

# --- Making a case ---------------------------------------------------------------------------------------------------
# Makes one case: draws the axis and what it conceals, records it, and writes down the truth. An effect whose torque
# cannot be seen is drawn stronger, one that makes the loop unstable weaker.


# --- The truth of a case ---------------------------------------------------------------------------------------------
# What is true of a case, said in the words of an axis model file; and what its user believes. Knows the file format of
# the outside contract, no model code.


def believed_model(physics: Physics, off: Sequence[float]) -> Document:
    """The model that the user has: a plain joint whose parameters are `off` by a share each."""
    model = plain_model(physics)
    friction = model["friction"]
    keys = ("viscous", "coulomb", "static", "stribeck_velocity", "sigma0", "sigma1")
    friction |= {key: round(friction[key] * (1.0 + share), 12) for key, share in zip(keys, off[1:7], strict=True)}
    if physics.static == physics.coulomb:
        friction["static"] = friction["coulomb"]
    model["inertia"] *= 1.0 + off[0]
    model[listed.GRAVITY]["amplitude"] *= 1.0 + off[7]
    return model


def true_model(physics: Physics, groups: Sequence[Document | None]) -> Document | None:
    """The model file that says all that is true; None where it has no words for it."""
    model = plain_model(physics)
    for group in groups:
        if group is None:
            return None
        model |= group
    return model


def plain_model(physics: Physics) -> Document:
    """The plain joint of an axis, both masses in one."""
    return {
        "inertia": physics.inertia + physics.load_inertia,
        "delay_s": 0.001,
        "friction": {
            "kind": "lugre",
            "viscous": physics.viscous + physics.load_viscous,
            "coulomb": physics.coulomb,
            "static": physics.static,
            "stribeck_velocity": physics.stribeck_velocity,
            "sigma0": physics.sigma0,
            "sigma1": physics.sigma1,
        },
        listed.GRAVITY: {"amplitude": physics.gravity, "phase": physics.gravity_phase},
    }


Array = NDArray[np.float64]

#: Torque noise and its share in Coulomb friction, encoder noise in counts, noise of the thermometer in degC.
TORQUE_NOISE, ENCODER_NOISE, THERMOMETER_NOISE_C = 0.01, 0.3, 0.02

#: An effect is seen when the command differs by this share of Coulomb friction in 2 % of the time; tries to get there.
SEEN, TRIES = 0.08, 8

#: A loop is sane while its error is below this share of the travel, its command at the limit for less than this share
#: of the time, its effort below this multiple of what it is without the effect, and all but 2 % of what the effect
#: changes below this share of the command's limit.
SANE_ERROR, SANE_LIMITED, SANE_EFFORT, SANE_CHANGE = 0.3, 0.15, 2.5, 0.6

#: Cover.NOISE: least factor on noise, factor on strength. Cover.ABSORBED: by how much the model's friction went along.
BELOW_NOISE, FAINT, TAKEN_UP = 3.0, 0.6, 0.08

#: How far (share) known parameters are off, and how large clutter is as a share of Coulomb friction.
OFF, CLUTTER = 0.04, 0.01

NAMES = ("rec_0_slow_sine", "rec_1_multisine", "rec_2_moves", "holdout")


@dataclass(frozen=True)
class Case:
    """What the user has (`model`, recordings: name -> column -> values) and what is true."""

    model: Document
    recordings: dict[str, dict[str, Array]]
    truth: dict[str, Any]


@dataclass(frozen=True)
class CaseRecorder:
    """How an axis is recorded: the controller, the torque noise in N*m, whether its temperature is, by which engine."""

    loop: Loop
    noise: float
    thermometer: bool
    engine: Engine = Engine.OWN


def make_case(plan: CaseSpec, settings: Settings) -> Case:
    """One case, the same for the same plan and settings."""
    rng = np.random.default_rng(plan.seed)
    axis = draw_axis(rng, plan.kind, plan.weight)
    loop = axis.loop if plan.cover is Cover.INTEGRATOR else axis.loop._replace(ki=0.0)
    axis = replace(axis, loop=loop)
    motions = int(rng.integers(2**31))
    hidden: list[Concealed] = []
    seen = []
    for name in plan.effects:
        concealed, size = draw_seen(name, axis, hidden, plan, rng, motions)
        axis = axis.with_travel(concealed.travel)
        hidden.append(concealed)
        seen.append(size)
    physics = _all_changes(axis.physics, hidden)
    plant = _cluttered(physics, axis, rng, plan.effects) if settings.clutter else physics
    noisy = max(settings.noise, BELOW_NOISE if plan.cover is Cover.NOISE else 1.0)
    recorder = CaseRecorder(
        loop, TORQUE_NOISE * noisy * axis.physics.coulomb, has_thermometer(hidden, plan.seed), settings.engine
    )
    believed = _believed(axis.physics, hidden)
    if plan.cover is Cover.ABSORBED:
        believed = _absorbing(believed, axis, physics, rng)
    off = rng.uniform(-OFF, OFF, 8).tolist() if plan.off else [0.0] * 8
    truth = _truth(plan, settings, axis, hidden, seen) | {
        "params": _own_numbers(plant),
        "true_model": true_model(physics, [c.model for c in hidden]),
    }
    recordings = record(plant, recorder, hidden, rng, references(axis, motions))
    return Case(believed_model(believed, off), recordings, truth)


def references(axis: CaseAxis, seed: int) -> list[Array]:
    """What the axis is asked to do in each of the recordings of NAMES, rad; the same for the same seed and travel."""
    motions = axis.motions
    kinds = (motions.slow_sine, motions.multisine, motions.moves, motions.mixed)
    return [kind(np.random.default_rng([seed, index])) for index, kind in enumerate(kinds)]


def has_thermometer(hidden: Sequence[Concealed], seed: int) -> bool:
    """Whether temperature is recorded: as what is concealed asks for, otherwise by chance, equally often."""
    asked = [c.thermometer for c in hidden if c.thermometer is not None]
    # chance of its own, so that nothing else of the case depends on it
    return all(asked) if asked else bool(np.random.default_rng([seed, 1]).uniform() >= NO_THERMOMETER)


def draw_seen(
    name: str, axis: CaseAxis, others: Sequence[Concealed], plan: CaseSpec, rng: np.random.Generator, motions: int
) -> tuple[Concealed, float]:
    """A drawing of an effect that shows beside others and leaves the loop stable; by how much the command differs.

    `motions` is the seed of the motions in which it must show: those that will be recorded.
    """
    seed = int(rng.integers(2**31))
    strength = FAINT if plan.cover in (Cover.NOISE, Cover.BAND) else 1.0
    enough = SEEN * (FAINT if plan.cover in (Cover.NOISE, Cover.BAND) else 1.0)
    hide = (UNLISTED if plan.sort is Sort.UNKNOWN else HIDE)[name]
    for _ in range(TRIES):
        concealed = hide(Draw(axis, np.random.default_rng(seed), strength, plan.other))
        size, sane = shows(axis.with_travel(concealed.travel), others, concealed, motions)
        if sane and size >= enough:
            break
        strength *= 1.45 if sane else 0.7
    return concealed, size


def shows(axis: CaseAxis, others: Sequence[Concealed], concealed: Concealed, motions: int) -> tuple[float, bool]:
    """By how much of Coulomb friction the command differs in 2 % of the time, and whether the loop remains sane.

    The holdout does not count: nobody sees it.
    """
    changed = _all_changes(axis.physics, [*others, concealed])
    plain = _all_changes(axis.physics, others)._replace(**concealed.believed)
    largest, sane = 0.0, True
    for wanted in references(axis, motions)[:-1]:
        there, without = (_followed(axis, physics, wanted) for physics in (changed, plain))
        largest = max(largest, float(np.quantile(np.abs(there[:, 0] - without[:, 0]), 0.98)))
        error = float(np.std(there[:, 1] - wanted)) / axis.motions.travel
        limited = float(np.mean(np.abs(there[:, 0]) >= 0.999 * axis.loop.limit))
        wilder = float(np.std(there[:, 0]) / np.std(without[:, 0]))
        sane = sane and error < SANE_ERROR and limited < SANE_LIMITED and wilder < SANE_EFFORT
    return largest / axis.physics.coulomb, sane and largest < SANE_CHANGE * axis.loop.limit


def _followed(axis: CaseAxis, physics: Physics, wanted: Array) -> Array:
    out, quiet = np.zeros((len(wanted), 3)), np.zeros(len(wanted))
    run(physics, axis.loop, rest(), wanted, quiet, quiet, out)
    return out


def record(
    plant: Physics,
    recorder: CaseRecorder,
    hidden: Sequence[Concealed],
    rng: np.random.Generator,
    wanted: Sequence[Array],
) -> dict[str, dict[str, Array]]:
    """Three recordings and the one held out of the motions `wanted`; the joint cools a little between them."""
    follow = engine.run if recorder.engine is Engine.MUJOCO else run
    warm, found = 25.0, {}
    for index, (name, reference) in enumerate(zip(NAMES, wanted, strict=True)):
        here = plant
        if any(c.only is not None and c.only != index for c in hidden):
            here = plant._replace(push=0.0)
        start = rest(25.0 if any(c.cold for c in hidden) else warm, float(rng.uniform(0.0, 50.0)))
        out = np.zeros((len(reference), 3))
        jitter = ENCODER_NOISE * rng.normal(size=len(reference))
        follow(here, recorder.loop, start, reference, recorder.noise * rng.normal(size=len(reference)), jitter, out)
        warm = 25.0 + 0.8 * (float(out[-1, 2]) - 25.0)
        found[name] = _columns(reference, out, rng, recorder.thermometer)
    return found


def _columns(reference: Array, out: Array, rng: np.random.Generator, thermometer: bool) -> dict[str, Array]:
    columns = {
        "t_s": 1e-3 * np.arange(len(reference), dtype=np.float64),
        "torque_nm": out[:, 0],
        "position_rad": out[:, 1],
        "reference_rad": reference,
    }
    if thermometer:
        columns["temperature_c"] = out[:, 2] + THERMOMETER_NOISE_C * rng.normal(size=len(reference))
    return columns


def _all_changes(physics: Physics, hidden: Sequence[Concealed]) -> Physics:
    """The axis with everything that it conceals."""
    for concealed in hidden:
        physics = physics._replace(**concealed.changes)
    return physics


def _believed(physics: Physics, hidden: Sequence[Concealed]) -> Physics:
    for concealed in hidden:
        physics = physics._replace(**concealed.believed)
    return physics


def _absorbing(believed: Physics, axis: CaseAxis, physics: Physics, rng: np.random.Generator) -> Physics:
    """The model's friction shifted to where a fit without the effect would have taken it."""
    wanted = axis.motions.slow_sine(rng, 8.0)
    there, without = (_followed(axis, p, wanted) for p in (physics, axis.physics))
    more = float(np.mean((there[:, 0] - without[:, 0]) * np.sign(np.gradient(wanted))))
    factor = 1.0 + TAKEN_UP * float(np.sign(more))
    return believed._replace(
        coulomb=factor * believed.coulomb, static=factor * believed.static, viscous=factor * believed.viscous
    )


def _cluttered(physics: Physics, axis: CaseAxis, rng: np.random.Generator, effects: Sequence[str]) -> Physics:
    """Three other effects, each so small that nobody would name it."""
    torque = CLUTTER * axis.physics.coulomb
    turns = 2.0 * axis.motions.travel / 6.283
    little: Mapping[str, dict[str, float]] = {
        listed.COGGING: {"cogging": torque, "cogging_order": round(7.0 / turns), "cogging_phase": 1.0},
        listed.ASYMMETRY: {"front_dry": 1.0 + CLUTTER, "back_dry": 1.0 - CLUTTER},
        listed.POSITION_DEPENDENT_FRICTION: {
            "grip_share": CLUTTER,
            "grip_order": round(3.0 / turns),
            "grip_phase": 2.0,
        },
        listed.TORQUE_OFFSET: {"offset": torque},
        listed.VISCOUS_NONLINEAR: {"drag_torque": torque, "drag_speed": axis.speed},
        listed.TORQUE_RIPPLE: {"ripple_share": CLUTTER, "ripple_order": round(5.0 / turns)},
    }
    for name in rng.permutation([name for name in little if name not in effects])[:3]:
        physics = physics._replace(**little[str(name)])
    return physics


def _own_numbers(plant: Physics) -> dict[str, float]:
    """Numbers of the plant that are not those of one that has nothing."""
    nothing = Physics()._asdict()
    return {key: float(value) for key, value in plant._asdict().items() if value != nothing[key]}


def _truth(
    plan: CaseSpec, settings: Settings, axis: CaseAxis, hidden: Sequence[Concealed], seen: Sequence[float]
) -> dict[str, Any]:
    known = plan.sort is not Sort.UNKNOWN
    return {
        "sort": plan.sort.value,
        "effects": list(plan.effects) if known else [],
        "unknown": None if known else plan.effects[0],
        "joint": plan.kind.value,
        "masked": plan.cover is Cover.INTEGRATOR,
        "cover": plan.cover.value,
        "forms": plan.other,
        "off": plan.off,
        "settings": asdict(settings) | {"engine": settings.engine.value},
        "strength": [round(size, 4) for size in seen],
        "coulomb": axis.physics.coulomb,
        "parameters": {
            name: {key: float(value) for key, value in concealed.parameters.items()}
            for name, concealed in zip(plan.effects, hidden, strict=True)
        },
    }


CASES, SEALED, TRUTH, HOLDOUT = "cases", "sealed", "truth.json", "holdout"


def conceal(plans: Sequence[CaseSpec], settings: Settings, out: Path, on_progress: OnCount) -> str:
    """Write folders into `out`/cases and the truth into `out`/sealed; returns the truth's SHA-256."""
    truths = {}
    for number, plan in enumerate(plans):
        name = f"c{number:03d}"
        case = make_case(plan, settings)
        truths[name] = case.truth
        write_case(case, out / CASES / name, out / SEALED / name)
        on_progress(number + 1, len(plans))
    whole = {"salt": secrets.token_hex(16), "cases": truths}
    content = (json.dumps(whole, indent=1, allow_nan=False) + "\n").encode()
    write_bytes(out / SEALED / TRUTH, content)
    lock(out)
    return hashlib.sha256(content).hexdigest()


def open_cases(plans: Sequence[CaseSpec], settings: Settings, out: Path, on_progress: OnCount) -> None:
    """Write folders with everything in them, truth.yaml as well, for whoever develops a diagnosis."""
    for number, plan in enumerate(plans):
        case = make_case(plan, settings)
        folder = out / f"c{number:03d}"
        write_case(case, folder, folder)
        write_bytes(folder / "truth.yaml", yaml.safe_dump(case.truth, sort_keys=False).encode())
        on_progress(number + 1, len(plans))


def write_case(case: Case, folder: Path, held: Path) -> None:
    """Model and recordings into `folder`, the recording that is held out into `held`."""
    write_bytes(folder / "model.yaml", yaml.safe_dump(case.model, sort_keys=False).encode())
    for name, columns in case.recordings.items():
        where = held if name == HOLDOUT else folder
        write_bytes(where / f"{name}.csv.gz", packed(columns))


def packed(columns: Mapping[str, NDArray[np.float64]]) -> bytes:
    """Columns as compressed CSV with nine digits; the same columns give the same bytes."""
    import pyarrow as pa
    import pyarrow.csv as pc

    table = pa.table({name: _rounded(values) for name, values in columns.items()})
    plain = io.BytesIO()
    plain.write((",".join(columns) + "\n").encode())
    pc.write_csv(table, plain, pc.WriteOptions(include_header=False))
    return gzip.compress(plain.getvalue(), 1, mtime=0)


def _rounded(values: NDArray[np.float64]) -> NDArray[np.float64]:
    largest = float(np.max(np.abs(values)))
    digits = 9 - (int(np.ceil(np.log10(largest))) if largest > 0.0 else 0)
    return np.round(values, digits)


def lock(out: Path) -> None:
    """Take from everybody the right to read what is sealed in `out`."""
    _allow(out, 0)


def unlock(out: Path) -> None:
    """Give it back to the owner."""
    _allow(out, 0o600)


def _allow(out: Path, mode: int) -> None:
    """Files, not their folder: whoever made a trial can still remove it."""
    for path in (out / SEALED).rglob("*"):
        if path.is_file():
            path.chmod(mode)


def read_truth(out: Path, digest: str) -> dict[str, Any]:
    """Open the seal: the truth of all cases. Raises ValueError when it is not the truth that was sealed."""
    unlock(out)
    content = (out / SEALED / TRUTH).read_bytes()
    found = hashlib.sha256(content).hexdigest()
    if found != digest:
        raise ValueError(f"{out / SEALED / TRUTH} has SHA-256 {found}, sealed was {digest}")
    cases: dict[str, Any] = json.loads(content)["cases"]
    return cases


# --- Settings and seal -----------------------------------------------------------------------------------------------
# What a trial is: its settings and the hash of its sealed truth, in one file of its folder. Under the three processes;
# each reads it, only the first writes it.


FILE = "trial.json"
_ALLOWED = "what `servoctl prove` wrote"
#: Folders of cases that lie open, or of a trial that was interrupted before its file was written.
_CASE = re.compile(r"c\d{3,5}").fullmatch


@dataclass(frozen=True)
class BlindTrial:
    """The cases of a trial and the hash of the sealed truth.

    `cases` are mixed, `null` more conceal nothing; by which seed, whether the harder ones, moved by which engine.
    """

    cases: int
    seed: int
    harder: bool
    null: int = 0
    engine: Engine = Engine.OWN
    sha256: str = ""
    version: str = __version__

    def same(self, other: BlindTrial) -> bool:
        """Whether both draw the same cases."""
        return replace(self, sha256="", version="") == replace(other, sha256="", version="")

    def __str__(self) -> str:
        null = f" and {self.null} that conceal nothing" if self.null else ""
        by = "" if self.engine == Engine.OWN else f", moved by {self.engine}"
        return f"{counted(self.cases, 'case')} of seed {self.seed}{null}" + (", harder" if self.harder else "") + by


def foreign_in(out: Path) -> list[str]:
    """Names in a folder that no trial put there; none where a trial's file says that the folder is one's."""
    if not is_there(out) or is_there(out / FILE) or not out.is_dir():
        return []
    return sorted(path.name for path in out.iterdir() if path.name not in (CASES, SEALED) and not _CASE(path.name))


def write_trial(out: Path, trial: BlindTrial) -> None:
    """Write the trial's file. Raises BadInput."""
    write_bytes(out / FILE, (json.dumps(asdict(trial)) + "\n").encode())


def read_trial(out: Path) -> BlindTrial | None:
    """The trial in a folder, if any. Raises BadInput when its file is no such file."""
    path = out / FILE
    if not path.exists():
        return None
    try:
        return BlindTrial(**read_json(path, _ALLOWED))
    except TypeError:
        raise BadInput(str(path), "other keys than a trial has", _ALLOWED) from None
