"""Figures of motions: tracking (Fig. 9, 10, 15, 18), steps (Fig. 16, 17), friction under disturbance (Fig. 11, 12).

Stands on motions as arrays, cut from cycle records or from the compiled simulator; both give the same figures.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from servod.common.faults import FaultCode
from servod.lab.recordings.recording import LARGEST, missing_samples
from servod.lab.report.figure import COLOURS, Array, Colour, Curve, Figure, PlotAxis, PlotPanel, Style, array, curve
from servod.lab.simulate.simulate import ClosedLoopRun

MILLI = 1e3
#: Trajectory (19) is scored without its first second.
SETTLE_S = 1.0


@dataclass(frozen=True)
class PlottedMotion:
    """One motion, a value for each cycle. `friction_nm` is the law's compensation, `joint_friction_nm` the
    joint's own.
    """

    label: str
    time_s: Array
    reference_rad: Array
    position_rad: Array
    torque_nm: Array
    friction_nm: Array
    joint_friction_nm: Array | None = None

    @property
    def error_mrad(self) -> Array:
        """Reference minus position."""
        return MILLI * (self.reference_rad - self.position_rad)

    def rms_mrad(self, after_s: float = SETTLE_S) -> float:
        """RMS of the error from `after_s` on."""
        error = self.error_mrad[self.time_s >= after_s]
        return float(np.sqrt(np.mean(error[np.isfinite(error)] ** 2)))

    def most_mrad(self, after_s: float) -> float:
        """Largest error from `after_s` on; 0 where there is none."""
        error = np.abs(self.error_mrad[self.time_s >= after_s])
        return float(error[np.isfinite(error)].max(initial=0.0))

    def part(self, from_s: float, to_s: float) -> PlottedMotion:
        """The cycles between both times, time counted from the first of them."""
        here = (self.time_s >= from_s) & (self.time_s < to_s)
        return PlottedMotion(
            self.label,
            self.time_s[here] - from_s,
            self.reference_rad[here],
            self.position_rad[here],
            self.torque_nm[here],
            self.friction_nm[here],
            None if self.joint_friction_nm is None else self.joint_friction_nm[here],
        )


def motion_of_rows(label: str, rows: NDArray[np.void]) -> PlottedMotion:
    """A motion from cycle records (dtype servod.lab.recordings.recording.ROW); positions are the encoder's."""
    time_s = (rows["time_ns"] - rows["time_ns"][0]) * 1e-9
    columns = ("reference_rad", "position_rad", "torque_nm", "torque_friction_nm")
    return PlottedMotion(label, array(time_s), *(array(rows[c]) for c in columns))


def motion_of_run(label: str, run: ClosedLoopRun, joint_friction_nm: Array | None = None) -> PlottedMotion:
    """A motion from the compiled simulator; positions are the true ones."""
    return PlottedMotion(
        label, run.t_s, run.reference_rad, run.position_rad, run.torque_nm, run.friction_nm, joint_friction_nm
    )


def tracking(motion: PlottedMotion, name: str = "tracking", title: str = "") -> Figure:
    """Position, error and torque of one motion below each other (Fig. 15)."""
    title = title or f"Tracking under {motion.label}"
    return Figure(name, title, tuple(_column(motion)), row_height=0.85)


def tracking_grid(
    motions: Sequence[PlottedMotion], name: str = "tracking", title: str = "Tracking", same_error_scale: bool = True
) -> Figure:
    """Position, error and torque of several motions, a column for each (Fig. 16, 17, 18).

    `same_error_scale` draws all errors on one scale, so that they can be compared by eye.
    """
    top = 1.05 * max(m.most_mrad(SETTLE_S) for m in motions)
    span = (-top, top) if same_error_scale else None
    columns = [_column(motion, span) for motion in motions]
    panels = [column[row] for row in range(3) for column in columns]
    return Figure(name, title, tuple(panels), len(motions), row_height=0.85)


def _column(motion: PlottedMotion, error_span: tuple[float, float] | None = None) -> list[PlotPanel]:
    t = PlotAxis("time in s")
    position = (
        curve("reference", motion.time_s, MILLI * motion.reference_rad, Colour.GREY, Style.DASHED),
        curve("position", motion.time_s, MILLI * motion.position_rad, Colour.BLUE),
    )
    error = (curve("error", motion.time_s, motion.error_mrad, Colour.ORANGE, width=1.0),)
    torque = [curve("torque", motion.time_s, MILLI * motion.torque_nm, Colour.BLACK, width=1.0)]
    if np.any(motion.friction_nm):
        torque.append(
            curve("of it friction compensation", motion.time_s, MILLI * motion.friction_nm, Colour.SKY, width=1.0)
        )
    return [
        PlotPanel(t, PlotAxis("position in mrad"), position, motion.label),
        PlotPanel(t, PlotAxis("error in mrad", span=error_span), error),
        PlotPanel(t, PlotAxis("torque in mN·m"), tuple(torque)),
    ]


def errors(
    motions: Sequence[PlottedMotion],
    name: str = "errors",
    title: str = "Tracking errors",
    after_s: float = SETTLE_S,
    scores: Mapping[str, float] | None = None,
) -> Figure:
    """All errors in one panel, and below it those under a tenth of the worst on a scale of their own.

    `scores` are the RMS errors in mrad that a report has of these motions already; the caption shows the same.
    """
    scores = dict(scores or {m.label: m.rms_mrad(after_s) for m in motions})
    colours = {m.label: COLOURS[i % len(COLOURS)] for i, m in enumerate(motions)}
    fine = [m for m in motions if scores[m.label] < 0.1 * max(scores.values())]
    panels = [_errors(shown, scores, colours, after_s) for shown in (motions, fine) if shown]
    caption = f"RMS from {after_s:g} s on: " + ", ".join(f"{k} {v:.4g} mrad" for k, v in scores.items()) + "."
    return Figure(name, title, tuple(panels), caption=caption)


def _errors(
    motions: Sequence[PlottedMotion], scores: dict[str, float], colours: dict[str, Colour], after_s: float
) -> PlotPanel:
    reach = 1.1 * max(m.most_mrad(after_s) for m in motions)
    curves = [curve(m.label, m.time_s, m.error_mrad, colours[m.label], width=1.0) for m in motions]
    title = "" if len(motions) == len(scores) else "those below a tenth of the worst"
    return PlotPanel(PlotAxis("time in s"), PlotAxis("error in mrad", span=(-reach, reach)), tuple(curves), title)


def before_after(
    before: PlottedMotion,
    after: PlottedMotion,
    name: str = "before_after",
    title: str = "Before and after",
    caption: str = "",
) -> Figure:
    """The same motion before and after a change: both errors, and both torques.

    The caption has the RMS errors of the whole motion, unless a report judges it by other figures and says so.
    """
    t = PlotAxis("time in s")
    shown = ((before, Colour.GREY), (after, Colour.BLUE))
    error = [curve(m.label, m.time_s, m.error_mrad, colour, width=1.1) for m, colour in shown]
    torque = [curve(m.label, m.time_s, MILLI * m.torque_nm, colour, width=1.1) for m, colour in shown]
    caption = caption or f"RMS error {before.rms_mrad(0.0):.4g} mrad before, {after.rms_mrad(0.0):.4g} mrad after."
    panels = (
        PlotPanel(t, PlotAxis("error in mrad"), tuple(error)),
        PlotPanel(t, PlotAxis("torque in mN·m"), tuple(torque)),
    )
    return Figure(name, title, panels, caption=caption)


def steps(
    motions: Sequence[PlottedMotion], name: str, title: str, settled_s: float = 0.15, shown_s: float = 0.6
) -> Figure:
    """Step responses over each other (Fig. 16, 17): position, the error near its end, torque, for `shown_s`.

    Motions begin with the step. The panel of the error shows what is left from `settled_s` on.
    """
    motions = [m.part(0.0, shown_s) for m in motions]
    colours = [COLOURS[i % len(COLOURS)] for i in range(len(motions))]
    t = PlotAxis("time in s")
    position = [curve(m.label, m.time_s, MILLI * m.position_rad, c) for m, c in zip(motions, colours, strict=True)]
    goal = curve("reference", motions[0].time_s, MILLI * motions[0].reference_rad, Colour.GREY, Style.DASHED)
    rest = [curve(m.label, m.time_s, m.error_mrad, c, width=1.1) for m, c in zip(motions, colours, strict=True)]
    torque = [
        curve(m.label, m.time_s, MILLI * m.torque_nm, c, width=1.0) for m, c in zip(motions, colours, strict=True)
    ]
    span = 1.1 * max(*(m.most_mrad(settled_s) for m in motions), 1e-3)
    panels = (
        PlotPanel(t, PlotAxis("position in mrad"), (goal, *position)),
        PlotPanel(
            t,
            PlotAxis("error in mrad", span=(-span, span)),
            tuple(rest),
            f"error, scale of what is left after {settled_s:g} s",
        ),
        PlotPanel(t, PlotAxis("torque in mN·m"), tuple(torque)),
    )
    return Figure(name, title, panels, row_height=0.9)


def position_and_friction(motions: Sequence[PlottedMotion], name: str, title: str) -> Figure:
    """Position (left), control signal and friction (right), a row for each motion (Fig. 9, 10)."""
    panels = [panel for motion in motions for panel in _position_and_friction(motion)]
    return Figure(name, title, tuple(panels), 2)


def _position_and_friction(motion: PlottedMotion) -> tuple[PlotPanel, PlotPanel]:
    t = PlotAxis("time in s")
    torque: list[Curve] = [curve("control signal", motion.time_s, MILLI * motion.torque_nm, Colour.BLACK, width=1.0)]
    if motion.joint_friction_nm is not None:
        friction = MILLI * motion.joint_friction_nm
        torque.append(curve("friction of the joint", motion.time_s, friction, Colour.ORANGE, Style.DASHED))
    position = _column(motion)[0]
    return position, PlotPanel(t, PlotAxis("torque in mN·m"), tuple(torque))


def disturbed_friction(nominal: PlottedMotion, disturbed: PlottedMotion, name: str = "disturbed_friction") -> Figure:
    """Friction of the joint with and without the added disturbance (Fig. 11), and the errors of both (Fig. 12)."""
    t = PlotAxis("time in s")
    shown = ((disturbed, Colour.ORANGE, Style.LINE), (nominal, Colour.BLUE, Style.LINE))
    friction = [
        curve(m.label, m.time_s, MILLI * m.joint_friction_nm, colour, style, 1.0)
        for m, colour, style in shown
        if m.joint_friction_nm is not None
    ]
    error = [curve(m.label, m.time_s, m.error_mrad, colour, style, 1.0) for m, colour, style in shown]
    caption = f"RMS error {nominal.rms_mrad():.4g} mrad without, {disturbed.rms_mrad():.4g} mrad with the disturbance."
    panels = (
        PlotPanel(t, PlotAxis("friction in mN·m"), tuple(friction), "friction of the joint"),
        PlotPanel(t, PlotAxis("error in mrad"), tuple(error), "tracking error"),
    )
    return Figure(name, "Friction tuned from its nominal level by filtered noise", panels, caption=caption)


# A recording over time: what the loop wanted, what it got, what it commanded, and what axis and drive said of it.


#: Places of a state panel: names of the states by their number in the record.
StateNames = tuple[str, ...]


@dataclass(frozen=True)
class RecordedRun:
    """Columns of a recording that can be drawn, by their names in the cycle record (rad, N*m) or those of a linear axis
    (m, N), and the time of each row in s.

    `states` names what the columns of states hold: (column, title of its panel, names by number). `sets` names the gain
    sets of the column `controller`, and `damage` says what is missing of the file.
    """

    title: str
    time_s: Array
    columns: Mapping[str, NDArray[np.generic]]
    states: tuple[tuple[str, str, StateNames], ...] = ()
    sets: Mapping[int, str] = field(default_factory=dict)
    damage: str = ""

    def between(self, from_s: float | None, to_s: float | None) -> RecordedRun:
        """The rows from `from_s` to before `to_s` (None: its begin, its end)."""
        first = 0 if from_s is None else int(np.searchsorted(self.time_s, from_s))
        last = len(self.time_s) if to_s is None else int(np.searchsorted(self.time_s, to_s))
        columns = {name: values[first:last] for name, values in self.columns.items()}
        return replace(self, time_s=self.time_s[first:last], columns=columns)


#: Names in the record, and in the legend; each is drawn where the recording has it.
_TORQUES = (
    ("torque_nm", "commanded", Colour.BLACK),
    ("torque_actual_nm", "measured by the drive", Colour.GREY),
    ("torque_feedback_nm", "part: state feedback", Colour.BLUE),
    ("torque_friction_nm", "part: friction compensation", Colour.ORANGE),
    ("torque_other_nm", "part: observer, feed-forward, offset", Colour.GREEN),
)
_FORCES = (("force_n", "commanded", Colour.BLACK), ("force_actual_n", "measured by the drive", Colour.GREY))


def recorded_run(run: RecordedRun, name: str = "recording") -> Figure:
    """Reference and position, error, torque with its parts, states, and faults, one below the other."""
    rotary = "position_rad" in run.columns
    unit = "rad" if rotary else "m"
    position, reference = run.columns[f"position_{unit}"], run.columns.get(f"reference_{unit}")
    x = run.time_s
    t = PlotAxis("time in s", span=(float(x[0]), float(x[-1])))  # a short fault stands below its time
    curves = [] if reference is None else [curve("reference", x, reference, Colour.GREY, Style.DASHED)]
    panels = [PlotPanel(t, PlotAxis(f"position in {unit}"), (*curves, curve("position", x, position, Colour.BLUE)))]
    if reference is not None:
        error = MILLI * (array(reference) - array(position))
        panels.append(
            PlotPanel(t, PlotAxis(f"error in m{unit}"), (curve("error", x, error, Colour.ORANGE, width=1.0),))
        )
    torques = tuple(
        curve(label, x, run.columns[column], colour, width=1.0)
        for column, label, colour in (_TORQUES if rotary else _FORCES)
        if column in run.columns
    )
    panels.append(PlotPanel(t, PlotAxis("torque in N·m" if rotary else "force in N"), torques))
    panels += [_states(run, t, *shown) for shown in run.states if shown[0] in run.columns]
    faults = _faults(run, t)
    title = f"{run.title} (incomplete)" if run.damage else run.title
    return Figure(name, title, tuple(panels + faults), caption=describe_run(run), row_height=0.75)


def _states(run: RecordedRun, t: PlotAxis, column: str, title: str, names: StateNames) -> PlotPanel:
    """A line that jumps where the state changes; the states that occur have a place each, in the order of the enum."""
    occur, levels = np.unique(array(run.columns[column]), return_inverse=True)
    shown = tuple(names[int(k)] if 0 <= k < len(names) else f"{k:g}" for k in occur)
    x, y = _stairs(run.time_s, levels.astype(np.float64))
    return PlotPanel(
        t, PlotAxis("", span=(-0.5, len(shown) - 0.5), names=shown), (curve(title, x, y, Colour.PURPLE),), title
    )


def _stairs(x: Array, y: Array) -> tuple[Array, Array]:
    """The corners of a series that holds its values: at each change the value of before, and the new one."""
    at = np.flatnonzero(np.diff(y)) + 1
    ends = np.array([0, len(y) - 1]) if len(y) else np.zeros(0, dtype=np.int64)
    corners = np.sort(np.concatenate([ends, at, at]))
    ys = y[corners]
    second = np.append(corners[1:] == corners[:-1], False) if len(corners) else np.zeros(0, dtype=np.bool_)
    ys[second & np.isin(corners, at)] = y[corners[second & np.isin(corners, at)] - 1]
    return x[corners], ys


def _faults(run: RecordedRun, t: PlotAxis) -> list[PlotPanel]:
    """A bar over the time in which a fault was present, in a row for each; no panel where none was."""
    bits = np.asarray(run.columns.get("faults", np.zeros(len(run.time_s))), dtype=np.int64)
    codes = [code for code in FaultCode if np.any(bits & (1 << code))]
    if not codes:
        return []
    curves = []
    for level, code in enumerate(codes):
        present = np.concatenate([[0], (bits >> code) & 1, [0]])
        begins, ends = np.flatnonzero(np.diff(present) > 0), np.flatnonzero(np.diff(present) < 0) - 1
        until_s = run.time_s[np.minimum(ends + 1, len(run.time_s) - 1)]
        x = np.column_stack([run.time_s[begins], until_s, until_s]).ravel()
        y = np.tile([float(level), float(level), np.nan], len(begins))
        curves.append(curve("fault", x, y, Colour.ORANGE, width=5.0, detail=code.name))
        curves.append(curve("fault", x[::3], y[::3], Colour.ORANGE, Style.POINTS, detail=code.name))  # seen from afar
    names = tuple(code.name for code in codes)
    return [PlotPanel(t, PlotAxis("", span=(-0.5, len(names) - 0.5), names=names), tuple(curves), "faults present")]


def describe_run(run: RecordedRun) -> str:
    """How it went in one sentence: what the file lost, length, error, missing samples, faults with their times."""
    rows, unit = len(run.time_s), "rad" if "position_rad" in run.columns else "m"
    said = [f"Incomplete: {run.damage}"] if run.damage else []
    if not rows:
        return "; ".join([*said, "no cycles" if said else "No cycles"]) + "."
    said.append(f"{rows} cycles from {run.time_s[0]:.3f} to {run.time_s[-1]:.3f} s")
    if f"reference_{unit}" in run.columns:
        error = MILLI * (array(run.columns[f"reference_{unit}"]) - array(run.columns[f"position_{unit}"]))
        said += _following_errors(run, error, unit)
    said.append(_missing(run))
    if "faults" in run.columns:
        bits = np.asarray(run.columns["faults"], dtype=np.int64)
        at = {code.name: run.time_s[np.argmax((bits >> code) & 1)] for code in FaultCode if np.any(bits & (1 << code))}
        first = sorted(at.items(), key=lambda item: item[1])
        said.append(", ".join(f"{name} first at t = {t:.3f} s" for name, t in first) or "no fault present")
    return "; ".join(said) + "."


def _missing(run: RecordedRun) -> str:
    """Samples that are missing, and what is known of why: the loop skipped their periods, or they were not recorded."""
    cycle = run.columns.get("cycle")
    missing = int(missing_samples(run.time_s, None if cycle is None else array(cycle)).sum())
    said = f"missing samples: {missing}"
    if "missed" not in run.columns:
        return said
    skipped = int(run.columns["missed"][-1]) - int(run.columns["missed"][0])
    return said if skipped == missing else f"{said}, periods that the loop skipped: {skipped}"


def _following_errors(run: RecordedRun, error: Array, unit: str) -> list[str]:
    """Following error while the axis was enabled, for each gain set that ran then; of another recording, of all."""
    rows = np.ones(len(error), dtype=bool)
    enabled = next((names.index("ENABLED") for column, _, names in run.states if column == "axis_state"), None)
    if enabled is not None:
        rows = np.asarray(run.columns["axis_state"]) == enabled
        if not rows.any():
            return ["never enabled"]
    serials = np.asarray(run.columns.get("controller", np.zeros(len(error))))
    sentences = []
    for serial in dict.fromkeys(serials[rows]):
        of_set = error[rows & (serials == serial)]
        name = f" under gain set {int(serial)} of this run" if len(set(serials[rows])) > 1 else ""
        if name and serial in run.sets:
            name += f" ({run.sets[serial]})"
        sentences.append(_judged(of_set, unit) + name)
    return sentences


def _judged(error: Array, unit: str) -> str:
    """RMS and largest of the errors that are numbers, and how many are none, or none that was measured."""
    known = error[np.abs(error) < LARGEST]
    without = len(error) - len(known)
    if not len(known):
        return f"no error can be told, {without} cycles have none"
    rms, largest = np.sqrt(np.mean(known**2)), np.abs(known).max()
    sentence = f"RMS error {rms:.4g} m{unit}, largest {largest:.4g} m{unit}"
    return f"{sentence} ({without} of {len(error)} cycles, which have no error, left out)" if without else sentence
