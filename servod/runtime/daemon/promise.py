"""Whether the joint is still the one that the running gain set is certified for, cycle by cycle from the records.

Beside the loop, which it never touches: a joint that changed is told, with what changed and by how much. Two looks:

- Balance of momentum over short windows of motion one way, delay and filter taken out:
      int(u - T(x)) dt = m*dv + int F(v) dt,     F(v) = g(v) + d(v)*v as in (7), (18)
  gives m and the level of F in either direction as shares of the model's, by least squares that forgets. Reversals, in
  which the bristle turns over, lie between the windows; one whose dv may be the encoder's noise tells nothing of m.
- Error in each second against what the certificate promises of its validation motion, where the reference is as fast
  as one of its sines, and asks for no more acceleration.

Not seen: delay, a coupling, the torque's rate (limits and OSCILLATES). A load that the law does not know looks like
more friction one way and less the other, and is told as that or a load.

Source: (7), (18) of the paper; forgetting least squares with a prior that stays, Ljung, System Identification, ch. 11.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TypedDict

from servod.formats.gains.design import Design
from servod.formats.gains.gain_set import GainSet, Promise
from servod.formats.gains.parameters import LocalParameters
from servod.formats.recording.record import CycleRecord
from servod.kernels.laws.local import LocalGains
from servod.kernels.laws.position import position_torque
from servod.kernels.physics.effects import nonlinear_viscous
from servod.kernels.physics.friction import directed_curve
from servod.kernels.physics.layout import PackedPlant
from servod.runtime.loop.axis_state import AxisState

WINDOW_S = 0.02
#: Windows that count: after so many more an old one has 1/e of its weight.
_MEMORY = 250
#: Shares are near 1 by so much before anything was seen.
_PRIOR = 0.5
#: Windows are alike in what the model leaves out (cogging, temperature), so the scatter says too little.
_ALIKE = 3.0
#: A window may be off by this share of the friction in it, at least.
_LEAST_SCATTER = 0.02
#: Slower than this share of the design's top speed a joint may stick.
_SLIDES_SHARE = 0.04
#: A window tells of the inertia where its change of speed is so many times its noise.
_ABOVE_NOISE = 6.0
#: After a reversal the bristle has turned over when the joint has gone so many of its greatest deflections.
_TURNED_OVER = 3.0
#: Beyond the certified interval: what friction does over a day's temperature; and so many standard errors.
_OFF_BY, _SIGMAS = 0.15, 4.0
#: So many windows in a row must say so.
_STAYS = 25
ERROR_S = 1.0
#: An error is beyond the promise by this factor, in so many of the last windows.
_WORSE, _OF_WINDOWS, _LAST_WINDOWS = 2.0, 3, 4
#: The validation motion's slow sine (servod.lab.verify.validation): peak speed as a share of the design's, and Hz.
_SLOW_SHARE, _SLOW_HZ, _BRISK_SHARE, _BRISK_HZ, _BRISK_CYCLES = 0.126, 0.5, 0.5, 12.5, 60
_ROOM = 1.05
#: A sine of less speed at the same acceleration reverses more often on its bristle, of which nothing is promised.
_AS_FAST = 0.5

INERTIA, FORWARD, BACKWARD = "inertia", "friction forward", "friction backward"


class QuantityStatus(TypedDict):
    """A value of the joint as a share of the model's, with what it may be off by (one standard error) and the interval
    that is certified; `told` while it is beyond that by so much that it was told."""

    name: str
    share: float
    standard_error: float
    certified: list[float]
    told: bool


class ErrorStatus(TypedDict):
    """RMS error of the last window of a kind, in rad, beside what is promised; None before there was one. `told` once
    it was beyond that again and again."""

    kind: str
    rms_rad: float | None
    promised_rad: float
    told: bool


class PromiseStatus(TypedDict):
    """`judged`: the running set says what joint it is for; `note`: why nothing is said of the joint itself; `motion_s`
    is how much motion the shares stand on."""

    judged: bool
    note: str
    motion_s: float
    joint: list[QuantityStatus]
    errors: list[ErrorStatus]


@dataclass(frozen=True)
class Expected:
    """What a gain set says of the joint that it is certified for; `left_out` says why the balance is not judged."""

    law: LocalGains
    packed: PackedPlant
    gain: float
    period_s: float
    late_cycles: int
    slides_rad_s: float
    speed_noise_rad_s: float
    width: dict[str, float]
    left_out: str
    promised: Promise | None
    speed_max_rad_s: float

    @classmethod
    def of(cls, gains: GainSet) -> Expected | None:
        """None for a set that was designed for no joint, or that no certificate stands behind."""
        law, design, certificate = gains.parameters, gains.design, gains.certificate
        if not isinstance(law, LocalParameters) or design is None or certificate is None or not certificate.valid:
            return None
        return cls._of(law.named(), design, certificate.promised)

    @classmethod
    def _of(cls, law: LocalGains, design: Design, promised: Promise | None) -> Expected:
        model, u, period_s = design.model, design.uncertainty, design.period_s
        lag_s = model.actuator_lag.time_constant_s if model.actuator_lag else 0.0
        filter_s = 1.0 / (2.0 * math.pi * design.velocity_cutoff_hz)
        friction = u.dry + u.viscous + u.torque_gain
        packed, known = model.pack(), law.knows_position
        others = [name for name, group in model.groups() if not group.balanced or (group.held and not known)]
        if packed.p.offset and not known:
            others.append("an offset of the torque")
        return cls(
            law,
            packed,
            math.sqrt(packed.p.gain_positive * packed.p.gain_negative) or 1.0,  # none where the model states none
            period_s,
            # What the command of a cycle does is in the next cycle's velocity, half a cycle late by the difference.
            round((model.total_delay_s + lag_s + filter_s) / period_s + 1.5),
            _SLIDES_SHARE * design.speed_max_rad_s,
            _speed_noise_rad_s(design),
            {INERTIA: u.inertia + u.torque_gain, FORWARD: friction, BACKWARD: friction},
            f"the model has {', '.join(others)}" if others else "",
            promised,
            design.speed_max_rad_s,
        )

    @property
    def inertia(self) -> float:
        """All that moves, per unit of torque gain [kg*m^2]."""
        return (self.packed.p.inertia + self.packed.p.load_inertia) / self.gain

    def friction_nm(self, velocity_rad_s: float) -> float:
        """The model's friction of a joint that slides, per unit of torque gain."""
        p, v = self.packed.p, velocity_rad_s
        side = p.positive_viscous if v >= 0.0 else p.negative_viscous
        viscous = max(p.viscous * side + nonlinear_viscous(p, v), 0.0)
        return (math.copysign(directed_curve(*self.packed, v), v) + viscous * v) / self.gain


def _speed_noise_rad_s(design: Design) -> float:
    """RMS of the filtered velocity by rounding and noise of the encoder: a difference, and a first-order low-pass."""
    count_rad = 2.0 * math.pi / design.counts_per_turn if design.counts_per_turn else 0.0
    noise = design.model.noise
    read_rad = math.hypot(count_rad / math.sqrt(12.0), noise.encoder_rms if noise else 0.0)
    kept = math.exp(-2.0 * math.pi * design.velocity_cutoff_hz * design.period_s)
    return read_rad / design.period_s * (1.0 - kept) * math.sqrt(2.0 / (1.0 + kept))


class ShareEstimator:
    """Forgetting least squares of the three shares, with the prior that they are 1."""

    def __init__(self) -> None:
        self._information = [[0.0] * 3 for _ in range(3)]
        self._right = [0.0] * 3
        self._scatter, self._weight = 0.0, 0.0
        self.values, self.errors = [1.0] * 3, [_PRIOR] * 3

    def add(self, row: Sequence[float], found: float, scale: float) -> None:
        """One window: `found` = row*values, each give or take `scale`."""
        keep, phi = 1.0 - 1.0 / _MEMORY, [x / scale for x in row]
        residual = (found - sum(x * v for x, v in zip(row, self.values, strict=True))) / scale
        self._scatter, self._weight = keep * self._scatter + residual * residual, keep * self._weight + 1.0
        for i in range(3):
            self._right[i] = keep * self._right[i] + phi[i] * found / scale
            for j in range(3):
                self._information[i][j] = keep * self._information[i][j] + phi[i] * phi[j]
        prior = 1.0 / _PRIOR**2
        a = [[x + (prior if i == j else 0.0) for j, x in enumerate(own)] for i, own in enumerate(self._information)]
        inverse = _inverse(a)
        right = [x + prior for x in self._right]
        self.values = [sum(x * y for x, y in zip(own, right, strict=True)) for own in inverse]
        spread = _ALIKE * math.sqrt(max(1.0, self._scatter / self._weight))
        self.errors = [spread * math.sqrt(inverse[i][i]) for i in range(3)]


def _inverse(a: Sequence[Sequence[float]]) -> list[list[float]]:
    """Of a positive definite 3 by 3 matrix, by its cofactors."""
    (p, q, r), (_, s, t), (_, _, u) = a
    minors = [s * u - t * t, r * t - q * u, q * t - r * s, p * u - r * r, q * r - p * t, p * s - q * q]
    det = p * minors[0] + q * minors[1] + r * minors[2]
    aa, ab, ac, bb, bc, cc = (x / det for x in minors)
    return [[aa, ab, ac], [ab, bb, bc], [ac, bc, cc]]


@dataclass
class _Window:
    """Sums over the cycles of a window of one-way motion."""

    cycles: int = 0
    way: float = 0.0
    began_rad_s: float = 0.0
    last_rad_s: float = 0.0
    torque: float = 0.0
    friction: float = 0.0


@dataclass
class _Errors:
    """A second of a reference that moves."""

    cycles: int = 0
    squares: float = 0.0
    speed_rad_s: float = 0.0
    acceleration_rad_s2: float = 0.0
    last_rad_s: float | None = None  # none after a gap: what the reference did in it is not known


def _finite(record: CycleRecord) -> bool:
    values = record.torque_nm, record.velocity_rad_s, record.position_rad, record.reference_rad
    return all(map(math.isfinite, values))


@dataclass
class PromiseWatch:
    """Looks at every record; `see` says in a sentence what is not as certified any more, each thing once."""

    expected: Expected | None = None
    serial: int = -1
    shares: ShareEstimator = field(default_factory=ShareEstimator)
    motion_s: float = 0.0

    def __post_init__(self) -> None:
        self.begin(self.serial, self.expected)

    def begin(self, serial: int, expected: Expected | None) -> None:
        """Another gain set runs: nothing was seen of its joint yet."""
        self.serial, self.expected, self.shares, self.motion_s = serial, expected, ShareEstimator(), 0.0
        self._torques: deque[float] = deque(maxlen=1 + (expected.late_cycles if expected else 0))
        self._cycle = -1
        self._windows_off = dict.fromkeys((INERTIA, FORWARD, BACKWARD), 0)
        self._reported: set[str] = set()
        self._worse: dict[str, deque[bool]] = {}
        self._rms_rad: dict[str, float] = {}
        self._interrupt()

    def see(self, records: Sequence[CycleRecord]) -> list[str]:
        """One sentence for each thing that is not as certified, when it begins; for an enabled axis."""
        if self.expected is None:
            return []
        found = []
        for record in records:
            follows, self._cycle = record.cycle == self._cycle + 1, record.cycle
            controlled = record.axis_state == AxisState.ENABLED and record.controller == self.serial
            if not (controlled and follows and record.encoder_age == 0 and _finite(record)):
                self._interrupt()
                continue
            if sentence := self._balance(record, self.expected):
                found.append(sentence)
            if sentence := self._error(record, self.expected):
                found.append(sentence)
        return found

    def _interrupt(self) -> None:
        self._torques.clear()
        self._window, self._errors = _Window(), _Errors()
        self._way = self._turned_at_rad = 0.0

    def _balance(self, record: CycleRecord, e: Expected) -> str:
        """The momentum of the window that ends with this cycle."""
        if e.left_out:
            return ""
        v, w, torques = record.velocity_rad_s, self._window, self._torques
        known_nm = position_torque(e.law.position, record.position_rad, 0.0) if e.law.knows_position else 0.0
        torques.append(record.torque_nm)
        way = self._slides(record, e)
        if way == 0.0 or way != w.way or len(torques) <= e.late_cycles:
            self._window = _Window(0, way, v, v)
            return self._close(w, e) if w.cycles * e.period_s >= 0.5 * WINDOW_S else ""
        w.cycles, w.last_rad_s = w.cycles + 1, v
        w.torque += (torques[0] - known_nm) * e.period_s
        w.friction += e.friction_nm(v) * e.period_s
        if w.cycles * e.period_s < WINDOW_S:
            return ""
        self._window = _Window(0, way, v, v)
        return self._close(w, e)

    def _slides(self, record: CycleRecord, e: Expected) -> float:
        """The way that the joint slides, 0.0 where it may stick or its bristle is still being turned over."""
        v = record.velocity_rad_s
        if v * self._way <= 0.0:
            self._way, self._turned_at_rad = math.copysign(1.0, v) if v else 0.0, record.position_rad
        turned_over = abs(record.position_rad - self._turned_at_rad) > _TURNED_OVER * e.law.state_limit
        return self._way if turned_over and abs(v) > e.slides_rad_s else 0.0

    def _close(self, w: _Window, e: Expected) -> str:
        """A whole window, or what the joint left of it when it came to rest."""
        change = w.last_rad_s - w.began_rad_s
        change_noise_rad_s = math.sqrt(2.0) * e.speed_noise_rad_s
        noise = e.inertia * math.sqrt(2.0) * e.speed_noise_rad_s
        # Noise in what is regressed on would draw the inertia to nothing: such a change is taken as the model has it.
        above_noise = abs(change) > _ABOVE_NOISE * change_noise_rad_s
        row = [e.inertia * change if above_noise else 0.0, max(w.friction, 0.0), min(w.friction, 0.0)]
        found = w.torque if above_noise else w.torque - e.inertia * change
        self.shares.add(row, found, math.hypot(_LEAST_SCATTER * w.friction, noise) or 1.0)
        self.motion_s += w.cycles * e.period_s
        return self._drifted(e)

    def _drifted(self, e: Expected) -> str:
        texts = []
        for name, share, error in zip(self._windows_off, self.shares.values, self.shares.errors, strict=True):
            off = abs(share - 1.0) > e.width[name] + _OFF_BY + _SIGMAS * error
            self._windows_off[name] = self._windows_off[name] + 1 if off else 0
            if not off:
                self._reported.discard(name)
            elif self._windows_off[name] >= _STAYS and name not in self._reported:
                self._reported.add(name)
                texts.append(f"{name} is {share:.2f} times the model's (give or take {2.0 * error:.2f})")
        _, forward, backward = self.shares.values
        if texts and (forward - 1.0) * (backward - 1.0) < 0.0:
            texts.append("a load that the law does not know would look like this")
        return "; ".join(texts)

    def _error(self, record: CycleRecord, e: Expected) -> str:
        """RMS error of a window of motion, where the promise speaks of such motion."""
        own, v = self._errors, record.reference_velocity_rad_s
        if e.promised is None or not record.reference_active:
            self._errors = _Errors(last_rad_s=0.0)  # a motion that begins at speed is a jump
            return ""
        if own.last_rad_s is not None:
            own.acceleration_rad_s2 = max(own.acceleration_rad_s2, abs(v - own.last_rad_s) / e.period_s)
        own.last_rad_s, own.cycles = v, own.cycles + 1
        own.speed_rad_s = max(own.speed_rad_s, abs(v))
        own.squares += (record.reference_rad - record.position_rad) ** 2
        if own.cycles * e.period_s < ERROR_S:
            return ""
        self._errors = _Errors(last_rad_s=v)
        kind, promised_rad = self._kind(own, e, e.promised)
        if not kind:
            return ""
        rms_rad = math.sqrt(own.squares / own.cycles)
        self._rms_rad[kind] = rms_rad
        worse = self._worse.setdefault(kind, deque(maxlen=_LAST_WINDOWS))
        worse.append(rms_rad > _WORSE * promised_rad)
        if not any(worse):
            self._reported.discard(kind)
        if sum(worse) < _OF_WINDOWS:
            return ""
        if kind in self._reported:
            return ""
        self._reported.add(kind)
        return f"RMS error {1e3 * rms_rad:.3g} mrad in {kind} motion, promised {1e3 * promised_rad:.3g} mrad"

    def _kind(self, own: _Errors, e: Expected, promised: Promise) -> tuple[str, float]:
        """Which sine of the validation motion asks for as much, and what is promised of it."""
        slow = _ROOM * _SLOW_SHARE * e.speed_max_rad_s
        if _AS_FAST * slow <= own.speed_rad_s <= slow and own.acceleration_rad_s2 <= slow * 2.0 * math.pi * _SLOW_HZ:
            return "slow", promised.slow_rad
        brisk, hz = _ROOM * _BRISK_SHARE * e.speed_max_rad_s, min(_BRISK_HZ, 1.0 / (_BRISK_CYCLES * e.period_s))
        if _AS_FAST * brisk <= own.speed_rad_s <= brisk and own.acceleration_rad_s2 <= brisk * 2.0 * math.pi * hz:
            return "brisk", max(promised.brisk_rad, promised.slow_rad)
        return "", 0.0

    def status(self) -> PromiseStatus:
        """What was seen so far."""
        e = self.expected
        if e is None:
            return {"judged": False, "note": "", "motion_s": 0.0, "joint": [], "errors": []}
        joint: list[QuantityStatus] = [
            {
                "name": name,
                "share": share,
                "standard_error": error,
                "certified": [1.0 - e.width[name], 1.0 + e.width[name]],
                "told": name in self._reported,
            }
            for name, share, error in zip(self._windows_off, self.shares.values, self.shares.errors, strict=True)
            if not e.left_out
        ]
        promised = {} if e.promised is None else {"slow": e.promised.slow_rad, "brisk": e.promised.brisk_rad}
        errors: list[ErrorStatus] = [
            {"kind": kind, "rms_rad": self._rms_rad.get(kind), "promised_rad": rad, "told": kind in self._reported}
            for kind, rad in promised.items()
        ]
        return {"judged": True, "note": e.left_out, "motion_s": self.motion_s, "joint": joint, "errors": errors}
