"""From a recording as it comes to a trace that may be compared with a model; or the reason why it cannot tell.

Stands between `servod.lab.recordings` (names, units, holes, time) and the predictor. Every repair is a note in the
report.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from servod.formats.model.axis_model import AxisKind, AxisModel
from servod.lab.diagnose.data.trace import CheckedTrace, Rows, dry_friction
from servod.lab.diagnose.result import RefusedRecording
from servod.lab.diagnose.settings import SETTINGS
from servod.lab.recordings import Quantity, Recording
from servod.lab.simulate.motion import noise_rms
from servod.lab.simulate.replay import Drive, driven, switched_on

Array = NDArray[np.float64]

#: Degrees in a radian.
DEGREES = 180.0 / math.pi

#: Rows of the neighbourhood whose median a glitch leaves.
NEIGHBOURHOOD = 7

#: So many names of columns that were not used are listed.
NAMES_LISTED = 6


def load_traces(recordings: Sequence[Recording], model: AxisModel) -> tuple[list[CheckedTrace], list[RefusedRecording]]:
    """Traces of the recordings that can tell, and why the others cannot; names are unique."""
    traces: list[CheckedTrace] = []
    refused: list[RefusedRecording] = []
    for index, recording in enumerate(recordings):
        name = recording.path.name
        if any(other.path.name == name for other in recordings[:index]):
            name = f"{recording.path.parent.name}/{name}"
        trace = make_trace(recording, name, index * SETTINGS.intake.apart_s, model)
        reason = refusal_reason(trace, model)
        if reason is None:
            traces.append(trace)
        else:
            refused.append(RefusedRecording(name, reason, trace.notes))
    return traces, refused


def make_trace(recording: Recording, name: str, shift_s: float, model: AxisModel) -> CheckedTrace:
    """The recording with glitches repaired, on a time of its own; its command goes through the drive of the model."""
    notes = [_shorten_note(note) for note in recording.report]
    drive = recording.driven_by(model)
    counts = recording.measured.copy()
    position = _unwrap(drive.position, notes)
    position = _remove_glitches(position, "position", counts, notes)
    if drive.told is None:
        torque, command_rows = _remove_glitches(drive.torque, "command", counts, notes), None
    else:
        guessed = bool(drive.told.on.all())
        drive = driven(model, switched_on(model, replace(drive, position=position)))[1]
        torque, command_rows = drive.torque, drive.told
        _leave_out_off(command_rows.on if command_rows else counts, drive.t_s, counts, notes, guessed=guessed)
    _note_saturation(torque, notes)
    t_s = drive.t_s - drive.t_s[0] + shift_s
    warm = recording.get(Quantity.TEMPERATURE)
    has_temperature = (
        warm is not None and bool(np.isfinite(drive.temperature_c).all()) and _temperature_changes(drive.temperature_c)
    )
    moved = Drive(t_s, torque, position, drive.temperature_c, command_rows)
    return CheckedTrace(name, moved, counts, tuple(notes), has_temperature, shift_s - float(drive.t_s[0]), shift_s)


def _leave_out_off(on: Rows, t_s: Array, counts: Rows, notes: list[str], *, guessed: bool) -> None:
    """Rows around the instant at which the drive goes off or on do not count.

    Nor do those in which it is off where that is `guessed` from the motion: where the recording says it, they show the
    axis alone.
    """
    if on.all():
        return
    notes.append(f"drive: off in {100.0 * float(np.mean(~on)):.0f} % of the rows, from {t_s[np.argmin(on)]:.3g} s on")
    if guessed:
        counts &= on
    for row in np.flatnonzero(np.diff(on.astype(np.int8))):
        counts &= np.abs(t_s - t_s[row]) > SETTINGS.intake.around_off_s


def _shorten_note(note: str) -> str:
    """A note whose list of names is cut."""
    head, colon, names = note.partition(": ")
    unused = names.split(", ")
    if not head.startswith("columns not used") or len(unused) <= NAMES_LISTED:
        return note
    return f"{head}{colon}{', '.join(unused[:NAMES_LISTED])} and {len(unused) - NAMES_LISTED} more"


def _temperature_changes(temperature_c: Array) -> bool:
    """Whether the temperature changes by more than its noise, and by more than the thermometer's last digit flickers.

    One that counts whole degrees and shows two or three of them says nothing of when the joint was warmer: what goes
    with the motion's phase would be taken for warmth.
    """
    steps = np.abs(np.diff(temperature_c))
    steps = steps[steps > 0.0]
    range_c = float(np.ptp(temperature_c))
    if not len(steps) or range_c < SETTINGS.intake.least_steps_warm * float(steps.min()) * (1.0 - 1e-6):
        return False
    return range_c > 10.0 * noise_rms(temperature_c) or range_c > 1.0


def _unwrap(position: Array, notes: list[str]) -> Array:
    """The position without jumps of a whole turn."""
    jumps = np.abs(np.diff(position)) > 0.9 * 2.0 * math.pi
    back = np.abs(np.abs(np.diff(position)) - 2.0 * math.pi) < 0.5
    if not jumps.any() or not back[jumps].all():
        return position
    notes.append(f"position: {int(jumps.sum())} jumps of a whole turn, joined")
    return np.unwrap(position)


def _remove_glitches(values: Array, what: str, counts: Rows, notes: list[str]) -> Array:
    """Single rows that leave both neighbours and come back are replaced by the line between these.

    A position that was replaced is no measurement and does not count; its neighbours do. The row of a command counts:
    nobody knows whether the drive obeyed it. If it did, a few rows mismatch, which the fit counts by distance only.
    """
    bad = find_glitches(values)
    if not bad.any():
        return values
    kept = np.flatnonzero(~bad)
    notes.append(f"{what}: {int(bad.sum())} glitches, the first in row {int(np.argmax(bad)) + 1}, replaced")
    if what == "position":
        counts &= ~bad
    return np.interp(np.arange(len(values)), kept, values[kept])


def find_glitches(values: Array) -> Rows:
    """Rows that leave the median of their neighbourhood far and alone."""
    from scipy.ndimage import median_filter

    off = np.abs(values - median_filter(values, NEIGHBOURHOOD, mode="nearest"))
    step = np.abs(np.diff(values))
    usual = float(np.quantile(step, 0.995)) if len(step) else 0.0
    return np.asarray(
        off > max(SETTINGS.intake.glitch_noises * noise_rms(values), SETTINGS.intake.glitch_steps * usual, 1e-300)
    )


def _at_limit(torque: Array) -> float:
    """Share of rows in which the command is cut off at the very end of its range.

    Steps and square waves stand there too and are not cut off: their command goes there from a level at which it was
    held, or from the other end, and leaves to one.
    """
    most = float(np.max(np.abs(torque)))
    if most <= 0.0:
        return 0.0
    at = np.abs(torque) >= most * (1.0 - 1e-9)
    same = np.concatenate([[False], np.diff(torque) == 0.0, [False]])
    held = same[:-1] | same[1:]  # as the row before, or as the one behind
    edges = np.flatnonzero(np.diff(at.astype(np.int8)))
    outside = np.where(at[edges], edges + 1, edges)
    steps = bool(held.mean() > SETTINGS.intake.held) and (not len(edges) or bool(held[outside].mean() > 0.9))
    return 0.0 if steps else float(np.mean(at))


def _note_saturation(torque: Array, notes: list[str]) -> None:
    share = _at_limit(torque)
    if share > SETTINGS.intake.noted_saturated:
        notes.append(f"command: at its limit in {100.0 * share:.0f} % of the rows")


def refusal_reason(trace: CheckedTrace, model: AxisModel) -> str | None:
    """Why this recording cannot tell anything about this model; None when it can."""
    recorded = _too_coarse(trace) or _too_short(trace) or _never_changes(trace)
    moved = _too_noisy(trace, model) or _too_still(trace)
    if trace.drive.told is None:
        return recorded or wrong_sign_or_unit(trace, model) or moved or _cut_off(trace, model)
    if model.drive is not None and model.drive.kind.feeds_back:  # a goal has the unit of the position
        return recorded or moved
    return recorded or wrong_sign_or_unit(trace, model) or moved  # what is at the drive's limit is the model's own


def _too_coarse(trace: CheckedTrace) -> str | None:
    """Friction and inertia of a servo axis act within milliseconds; and time may be in other units than seconds."""
    period_s = trace.period_s
    if period_s <= SETTINGS.intake.coarsest_s:
        return None
    most_s = SETTINGS.intake.coarsest_s
    return f"too coarse: {period_s:.3g} s between rows, at most {most_s:g} s; t_s is in seconds (--map scales it)"


def _too_short(trace: CheckedTrace) -> str | None:
    rows, least_s, least_rows = int(trace.counts.sum()), SETTINGS.intake.least_s, SETTINGS.intake.least_rows
    if trace.duration_s >= least_s and rows >= least_rows:
        return None
    return (
        f"too short: {trace.duration_s:.2f} s and {rows} rows, at least {least_s:g} s and {least_rows} rows are needed"
    )


def _too_still(trace: CheckedTrace) -> str | None:
    position = trace.drive.position
    steps = np.abs(np.diff(position))
    quantum = float(steps[steps > 0.0].min()) if np.any(steps > 0.0) else 0.0
    room = float(np.ptp(position))
    moving = float(np.mean(np.abs(trace.velocity) > 3.0 * trace.drive.motion[:, 3]))
    if (
        quantum > 0.0
        and room >= SETTINGS.intake.least_counts * max(quantum, trace.position_noise)
        and moving >= SETTINGS.intake.least_moving
    ):
        return None
    return f"too still: the axis moves over {room:.3g} in all, and in {100.0 * moving:.0f} % of the rows"


def _never_changes(trace: CheckedTrace) -> str | None:
    return "the command never changes" if float(np.ptp(trace.drive.torque)) == 0.0 else None


def _cut_off(trace: CheckedTrace, model: AxisModel) -> str | None:
    """Where the command stands at its limit and the motion needs more than that, the record is cut off, not the drive.

    A controller that asks for all that there is moves the joint by no more, and its recording tells as much as another.
    """
    share = _at_limit(trace.drive.torque)
    if share < SETTINGS.intake.saturated:
        return None
    most = float(np.max(np.abs(trace.drive.torque)))
    needed = np.sign(trace.drive.torque) * _needed(trace, model)
    at = trace.counts & np.isfinite(needed) & (np.abs(trace.drive.torque) >= most * (1.0 - 1e-9))
    needs = float(np.median(needed[at])) / most if at.any() else math.inf
    if needs < SETTINGS.intake.needs_more:
        return None
    return (
        f"saturated: the command stands at its limit in {100.0 * share:.0f} % of the rows, and the motion there needs "
        f"{needs:.3g} times as much"
    )


def _needed(trace: CheckedTrace, model: AxisModel) -> Array:
    """The torque that the model's motion, dry friction and weight need, N*m."""
    motion, dry, *weight = _known_parts(trace, model)
    pull = model.gravity.amplitude * weight[0] if model.gravity is not None else 0.0
    return np.asarray(motion + dry + pull)


def _too_noisy(trace: CheckedTrace, model: AxisModel) -> str | None:
    dry = dry_friction(model)
    spoken = SETTINGS.intake.noise_of_command * float(np.std(trace.drive.torque))
    noise = (
        model.inertia
        * SETTINGS.observer.slowest**2
        * trace.position_noise
        * math.sqrt(SETTINGS.observer.slowest * trace.period_s)
    )
    if noise <= SETTINGS.intake.most_noise * max(dry, spoken):
        return None
    return f"too noisy: encoder noise makes {noise:.3g} of torque, dry friction is {dry:.3g}"


@dataclass(frozen=True)
class Factor:
    """By how much one part of the needed torque stands in the command, with its standard error."""

    value: float
    error: float

    @property
    def sure(self) -> bool:
        """Whether it differs from nothing for certain."""
        return abs(self.value) > SETTINGS.intake.certain_errors * self.error


def wrong_sign_or_unit(trace: CheckedTrace, model: AxisModel) -> str | None:
    """A sign or a unit that cannot be, in one line; None when nothing speaks against the recording.

    The command against the torque that the model's motion needs. It is split by least squares into the model's inertial
    and viscous part, its dry friction, and what may be missing anywhere (a constant, and slow curves over position), so
    that physics that was left out is not taken for a wrong unit.
    """
    moved, dry, understood = factors(trace, model)
    if understood < SETTINGS.intake.understood:
        return None
    if dry.sure and dry.value < 0.0 and (moved.value < 0.0 or not moved.sure):
        return f"command and motion have opposite signs (friction stands in the command times {dry.value:.3g})"
    both = _unit_by_both(moved.value, dry.value, model) if moved.sure and dry.sure else None
    return both or _unit_by_motion(moved)


def _unit_by_both(moved: float, dry: float, model: AxisModel) -> str | None:
    """What speaks against the recording where the factors of motion and of dry friction are both certain."""
    apart = max(moved / dry, dry / moved) if moved * dry > 0.0 else math.inf
    scale = math.sqrt(abs(moved * dry))
    if apart < SETTINGS.intake.same_unit and not 1.0 / SETTINGS.intake.wrong_unit < scale < SETTINGS.intake.wrong_unit:
        return f"the command is {scale:.3g} times what the model needs: another unit, or another axis"
    if moved > 0.0 and 1.0 / SETTINGS.intake.same_unit < dry < SETTINGS.intake.same_unit:
        return _position_unit(moved, model)
    return None


def _unit_by_motion(moved: Factor) -> str | None:
    """What speaks against it where friction says nothing, beside a weight of many frictions: a factor beyond reason."""
    most = SETTINGS.intake.no_model
    if not moved.sure or 1.0 / most < abs(moved.value) < most:
        return None
    return f"the command is {moved.value:.3g} times what the model's motion needs: another unit, or another axis"


def _position_unit(moved: float, model: AxisModel) -> str | None:
    """Friction is as it should be, and what goes with the size of the motion is not."""
    if model.axis is AxisKind.ROTARY and 1.0 / SETTINGS.intake.same_unit < moved * DEGREES < SETTINGS.intake.same_unit:
        return f"the position looks like degrees: the motion needs {1.0 / moved:.3g} times the command"
    if moved < 0.25 / DEGREES:
        return f"the position looks like counts or another unit: the motion needs {1.0 / moved:.3g} times the command"
    return None


def factors(trace: CheckedTrace, model: AxisModel) -> tuple[Factor, Factor, float]:
    """Factors of motion (inertia and viscous friction) and of dry friction in the command, and the share understood."""
    x, rows = trace.drive.position, trace.counts & np.isfinite(trace.velocity)
    scaled_position = (x - float(np.mean(x[rows]))) / max(float(np.std(x[rows])), 1e-12)
    curve = [np.ones_like(x), scaled_position, scaled_position**2, scaled_position**3]
    motion, dry, *weight = _known_parts(trace, model)
    parts = [motion, dry, *curve, *weight]
    design, command = np.column_stack(parts)[rows], trace.drive.torque[rows]
    size = np.maximum(np.sqrt(np.mean(design**2, axis=0)), 1e-30)
    found, *_ = np.linalg.lstsq(design / size, command, rcond=None)
    left = command - design / size @ found
    free = max(len(command) / SETTINGS.intake.correlated_rows - len(found), 1.0)
    spread = np.linalg.pinv((design / size).T @ (design / size)) * len(command)
    errors = np.sqrt(np.maximum(np.diag(spread), 0.0) * float(np.mean(left**2)) / free) / size
    values = found / size
    understood = 1.0 - float(np.var(left)) / max(float(np.var(command)), 1e-30)
    return Factor(float(values[0]), float(errors[0])), Factor(float(values[1]), float(errors[1])), understood


def _known_parts(trace: CheckedTrace, model: AxisModel) -> list[Array]:
    """Torques of the model's inertia and viscous friction, of its dry friction, and how its weight pulls, if any."""
    v, rows = trace.velocity, trace.counts & np.isfinite(trace.velocity)
    slow = max(0.05 * float(np.std(v[rows])), 1e-12)
    emf = model.drive.back_emf if model.drive is not None and trace.drive.told is not None else 0.0
    motion = model.inertia * trace.acceleration + (model.friction.viscous + emf) * v
    parts = [motion, dry_friction(model) * np.tanh(v / slow)]
    if model.gravity is not None:
        parts.append(np.sin(trace.drive.position + model.gravity.phase))
    return parts
