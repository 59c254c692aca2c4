"""Writes an axis model for another engine and says what that costs: the room's entry, used by `servoctl export`.

A format is one row of FORMATS: what it leaves out, what it says, how it is written, and who runs it.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from servod import __version__
from servod.common.errors import BadInput
from servod.common.files import write_bytes
from servod.formats.model.axis_model import AxisKind, AxisModel
from servod.kernels.laws import LAWS
from servod.lab.export import mjcf, urdf
from servod.lab.export.mjcf import SOLIMP, SOLREF, STEP_S
from servod.lab.export.reduce import LostEffect, losses
from servod.lab.simulate.motion import Start, beginning
from servod.lab.simulate.replay import Array, Drive, Replay, hidden_motion, replay
from servod.lab.simulate.simulate import LoopSettings, simulate_closed_loop

#: What the file's joint is called where nobody says otherwise.
JOINT = "axis"


class Format(NamedTuple):
    """A language: what it has no words for, the model as it says it, the text of a file, whether MuJoCo reads it."""

    losses: tuple[LostEffect, ...]
    says: Callable[[AxisModel], AxisModel]
    write: Callable[[AxisModel, str], str]
    for_engine: bool


def _json(model: AxisModel, name: str) -> str:
    """The whole model as one JSON document: the keys of the axis model file, and the units that they are in."""
    units = ("m", "N") if model.axis is AxisKind.LINEAR else ("rad", "N*m")
    plain = model.model_dump(mode="json", exclude_none=True, exclude_defaults=True)
    document = {"axis_model": plain, "name": name, "units": {"position": units[0], "torque": units[1], "time": "s"}}
    return json.dumps(document | {"written_by": f"servod {__version__}"}, indent=1, allow_nan=False) + "\n"


FORMATS: dict[str, Format] = {
    "mujoco": Format(mjcf.LOSSES, mjcf.says, mjcf.write, True),
    "urdf": Format(urdf.LOSSES, urdf.says, urdf.write, True),
    "json": Format((), lambda model: model, _json, False),
}


@dataclass(frozen=True)
class Exported:
    """A written file and what is known of it.

    `round_trip`: None where no engine could be asked, and then `not_run` says why. `not_expressed`: lost effect ->
    window error that it causes by itself, RMS in `unit`. `judged_on`: recordings; empty for the model's own motion.
    """

    file: Path
    format: str
    joint: str
    unit: str
    horizon_s: float
    round_trip: RoundTrip | None
    not_run: str
    not_expressed: dict[str, float]
    judged_on: tuple[str, ...]

    def document(self) -> dict[str, Any]:
        """The JSON document of `servoctl export`."""
        return {
            "file": str(self.file),
            "format": self.format,
            "joint": self.joint,
            "unit": self.unit,
            "horizon_s": self.horizon_s,
            "round_trip": self.round_trip.document() if self.round_trip else None,
            "not_run": self.not_run,
            "not_expressed": self.not_expressed,
            "judged_on": list(self.judged_on),
        }


def export(model: AxisModel, kind: str, out: Path, joint: str, recorded: Sequence[tuple[str, Drive]]) -> Exported:
    """Write `model` in the format `kind` (a key of FORMATS) to `out`, and judge the file on the recordings given.

    Without recordings the model's own motion is the judge. Raises BadInput (the file cannot be written, the engine
    refuses it).
    """
    chosen = FORMATS[kind]
    said = chosen.says(model)
    text = chosen.write(said, joint)
    drives = [drive for _, drive in recorded] or [own_motion(model)]
    lost = costs(model, chosen.losses, drives)
    trip, not_run = _round_trip(chosen, said, text, joint, drives)
    write_bytes(out, text.encode())
    unit = "m" if model.axis is AxisKind.LINEAR else "rad"
    names = tuple(name for name, _ in recorded)
    return Exported(out, kind, joint, unit, HORIZON_S, trip, not_run, lost, names)


def _round_trip(
    chosen: Format, said: AxisModel, text: str, joint: str, drives: Sequence[Drive]
) -> tuple[RoundTrip | None, str]:
    """The file in the engine, or as our own reader understands it; None and the reason where there is no engine."""
    if not chosen.for_engine:
        read = AxisModel.model_validate(json.loads(text)["axis_model"])
        return reread(said, read, drives), ""
    try:
        return round_trip(said, text, joint, drives), ""
    except ImportError:
        return None, "MuJoCo is not installed: pip install 'servod[sim]' runs the file beside the model"


# --- What it costs ---------------------------------------------------------------------------------------------------
# What is lost costs so much, and what was written moves as ours does.
#
# Both are judged on motions under the same command, restarted from the recording every HORIZON_S: on recordings
# where some are given, otherwise on a motion of the full model along sines from creep to its working speed.


#: Time between restarts [s].
HORIZON_S = 0.25
#: Both simulations agree when their window errors differ by no more than this share of ours, or when the motions differ
#: by no more than this share of what the joint moves in a window.
AGREES = 0.02
#: The motion that is judged where there is no recording: sample time, duration, and peak speeds over the model's own.
_PERIOD_S, _DURATION_S, _SPEEDS = 0.001, 12.0, (0.03, 0.3, 1.0)
#: Bandwidth of the feedback that moves it [rad/s].
_BANDWIDTH = 12.0


@dataclass(frozen=True)
class RoundTrip:
    """The written file in an engine beside ours, over windows of `horizon_s` [s]; errors RMS, in rad (m).

    `ours`, `theirs`: against the recording, or the full model's motion; `apart`: of one another, as a share of the
    way that the joint makes in a window.
    """

    engine: str
    horizon_s: float
    ours: float
    theirs: float
    apart: float
    agrees: bool

    def document(self) -> dict[str, Any]:
        """The JSON document."""
        return asdict(self)


def own_motion(model: AxisModel) -> Drive:
    """The full model along sines under PD feedback, without noise; the command as it was given."""
    dry = _dry(model)
    stiffness = model.inertia * _BANDWIDTH**2
    reach = max(0.2, 3.0 * dry / stiffness)
    t = np.arange(0.0, _DURATION_S, _PERIOD_S)
    reference = np.zeros((len(t), 3))
    for number, share in enumerate(_SPEEDS):
        speed = share * max(1.0, reach * _BANDWIDTH / 4.0)
        frequency = min(0.9 + 0.3 * number, speed / reach / (2.0 * math.pi) * 3.0)
        angle = 2.0 * math.pi * frequency * t
        amplitude = speed / (2.0 * math.pi * frequency)
        reference += np.column_stack(
            [
                amplitude * (1.0 - np.cos(angle)),
                speed * np.sin(angle),
                speed * 2.0 * math.pi * frequency * np.cos(angle),
            ]
        )
    law = LAWS["pd"]
    gains = (stiffness, 2.0 * model.inertia * _BANDWIDTH, model.inertia)
    done = simulate_closed_loop(
        model.model_copy(update={"noise": None}), law, gains, reference, LoopSettings(_PERIOD_S, counts_per_turn=0.0)
    )
    return Drive(done.t_s, done.torque_nm, done.encoder_rad, np.full(len(t), np.nan))


def costs(model: AxisModel, steps: Sequence[LostEffect], drives: Sequence[Drive]) -> dict[str, float]:
    """Window error that each lost effect causes by itself: RMS over all motions, in rad (m)."""
    own = [replay(model, drive, HORIZON_S).position for drive in drives]

    def cost(loss: LostEffect) -> float:
        without = [replay(loss.without(model), drive, HORIZON_S).position for drive in drives]
        return _rms([mine - other for mine, other in zip(own, without, strict=True)])

    return {loss.name: cost(loss) for loss in losses(model, steps)}


def round_trip(said: AxisModel, text: str, joint: str, drives: Sequence[Drive]) -> RoundTrip:
    """The file `text` in MuJoCo beside the model that it says, in our simulator. Raises ImportError, BadInput."""
    ours = [replay(said, drive, HORIZON_S) for drive in drives]
    theirs = [
        run(text, joint, drive, mine.starts, _load_states(said, drive, mine.starts))
        for drive, mine in zip(drives, ours, strict=True)
    ]
    return _beside(theirs[0].engine, ours, [run.position for run in theirs], drives)


def reread(said: AxisModel, read: AxisModel, drives: Sequence[Drive]) -> RoundTrip:
    """A model that was written and read again, beside the one that was meant; both in our simulator."""
    ours, again = ([replay(model, drive, HORIZON_S) for drive in drives] for model in (said, read))
    return _beside(f"servod {__version__}", ours, [run.position for run in again], drives)


def _beside(engine: str, ours: Sequence[Replay], theirs: Sequence[Array], drives: Sequence[Drive]) -> RoundTrip:
    way = _rms([_window_way(drive, mine.starts) for drive, mine in zip(drives, ours, strict=True)])
    apart = _rms([mine.position - other for mine, other in zip(ours, theirs, strict=True)]) / max(way, 1e-12)
    error_ours = _rms([mine.error for mine in ours])
    error_theirs = _rms([other - drive.position for other, drive in zip(theirs, drives, strict=True)])
    agrees = abs(error_theirs - error_ours) <= AGREES * error_ours or apart <= AGREES
    return RoundTrip(engine, HORIZON_S, error_ours, error_theirs, apart, agrees)


def _load_states(said: AxisModel, drive: Drive, starts: NDArray[np.int64]) -> Array:
    """Position and velocity of the load at the rows `starts`, as our own replay has them."""
    packed = said.pack()
    rows = drive.t_s, drive.torque, drive.position, drive.motion
    first = beginning(Start.AUTO, *rows, free=False).under(packed.p.delay_s)
    return hidden_motion(packed, drive, first, starts)[:, 3:5]


def _window_way(drive: Drive, starts: NDArray[np.int64]) -> Array:
    """How far each row is from the begin of its window."""
    begun = np.searchsorted(starts, np.arange(len(drive.t_s)), side="right") - 1
    return drive.position - drive.position[starts[begun]]


def _rms(parts: Sequence[Array]) -> float:
    return float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))


def _dry(model: AxisModel) -> float:
    law = model.friction
    return max(abs(t) for t in law.torques) if law.kind == "local" else law.coulomb


# --- The engine ------------------------------------------------------------------------------------------------------
# MuJoCo under a recorded command: the written file moves, restarted from the recording as our own replay is. The wheel
# `mujoco` (extra `sim`) is asked for where a file is run. A second copy of the joint is led along the recorded motion
# all the time, so that what is hidden (bristles, lag, commands on their way) is there at each restart.


class EngineRun(NamedTuple):
    """What the engine made of a command: its name and version, and the position at each row, rad or m."""

    engine: str
    position: Array


def run(text: str, joint: str, drive: Drive, starts: NDArray[np.int64], load: Array) -> EngineRun:
    """Simulate the file `text` (MJCF or URDF) under the command of `drive`, restarted at the rows `starts`.

    `load`: position and velocity of what is behind the joint's spring at each start. Raises ImportError without the
    wheel, BadInput where the engine refuses the file.
    """
    import mujoco

    try:
        model = mujoco.MjModel.from_xml_string(text)
    except ValueError as refused:
        raise BadInput("the exported file", str(refused), f"what MuJoCo {mujoco.__version__} reads") from None
    model.opt.timestep = STEP_S
    # How softly an engine holds a joint that sticks is no matter of the axis: as hard as the MJCF file asks for.
    model.dof_solref[:], model.dof_solimp[:, :3] = SOLREF, SOLIMP
    low, high = model.jnt_actfrcrange[model.joint(joint).id] if model.jnt_actfrclimited.any() else (-np.inf, np.inf)
    command = np.clip(drive.torque, low, high)
    begins = dict(zip(starts.tolist(), load, strict=True))
    free, led = _Joint(mujoco, model, joint), _Joint(mujoco, model, joint)
    position = np.zeros(len(drive.t_s))
    steps = np.rint(np.diff(drive.t_s) / STEP_S).astype(int)
    for row, motion in enumerate(drive.motion):
        led.put(motion[0], motion[1])
        if row in begins:
            free.take(led)
            free.put_load(*begins[row])
        position[row] = free.position
        if row < len(steps):
            led.step(command[row], steps[row])
            free.step(command[row], steps[row])
    return EngineRun(f"MuJoCo {mujoco.__version__}", position)


class _Joint:
    """One copy of the axis in the engine."""

    def __init__(self, mujoco: Any, model: Any, name: str) -> None:
        self._engine, self._model, self._data = mujoco, model, mujoco.MjData(model)
        joint = model.joint(name)
        self._q, self._v = int(joint.qposadr[0]), int(joint.dofadr[0])
        loads = [n for n in range(model.njnt) if model.joint(n).name != name]
        self._load = (int(model.jnt_qposadr[loads[0]]), int(model.jnt_dofadr[loads[0]])) if loads else None
        self._control = next((n for n in range(model.nu) if model.actuator(n).name == "command"), None)

    @property
    def position(self) -> float:
        """Position of the motor's side."""
        return float(self._data.qpos[self._q])

    def put(self, position: float, velocity: float) -> None:
        """Lead the motor's side to where the recording has it."""
        self._data.qpos[self._q], self._data.qvel[self._v] = position, velocity

    def put_load(self, position: float, velocity: float) -> None:
        """Put what is behind the joint's spring somewhere; nothing where the joint is rigid."""
        if self._load is not None:
            self._data.qpos[self._load[0]], self._data.qvel[self._load[1]] = position, velocity

    def take(self, other: _Joint) -> None:
        """Become a copy of another joint's state, all that is hidden included."""
        kind = self._engine.mjtState.mjSTATE_INTEGRATION
        state = np.zeros(self._engine.mj_stateSize(self._model, kind))
        self._engine.mj_getState(self._model, other._data, state, kind)
        self._engine.mj_setState(self._model, self._data, state, kind)

    def step(self, torque: float, steps: int) -> None:
        """Let some steps of the engine pass under a held command; a file without an actuator takes it as a force."""
        if self._control is None:
            self._data.qfrc_applied[self._v] = torque
        else:
            self._data.ctrl[self._control] = torque
        self._engine.mj_step(self._model, self._data, nstep=steps)
