"""Whether the joint is still the one that the running gain set is certified for, cycle by cycle from the records.

Beside the loop, which it never touches: a joint that changed is told, with what changed and by how much. Two looks:

- Balance of momentum over short windows of motion one way, delay taken out:
      int(u - T(x)) dt = m*dv + int F(v) dt,     F(v) = c0*v/a(v) + d0*v as in (9), (16)
  gives m and the level of F in either direction as shares of the model's, by least squares that forgets. Nothing is
  differentiated twice, so coarse encoders do; a window that reverses holds the bristle's way, and is left out.
- Error of the reference in half a second against what the certificate promises of its validation motion, where the
  reference asks for no more speed and acceleration than that motion.

Source: (9), (16) of the paper; forgetting least squares with a prior that stays, Ljung, System Identification, ch. 11.
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
from servod.kernels.laws.weights import blended
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
#: Beyond the certified interval: what friction does over a day's temperature; and so many standard errors.
_BEYOND, _SIGMAS = 0.15, 4.0
#: So many windows in a row must say so.
_STAYS = 25
ERROR_S = 1.0
#: An error is beyond the promise by this factor, in so many of the last windows.
_WORSE, _OF_WINDOWS, _LAST_WINDOWS = 2.0, 3, 4
#: The validation motion's slow sine (servod.lab.verify.validation): peak speed as a share of the design's, and Hz.
_SLOW_SHARE, _SLOW_HZ, _BRISK_SHARE, _BRISK_HZ, _BRISK_CYCLES = 0.126, 0.5, 0.5, 12.5, 60
_ROOM = 1.05

INERTIA, FORWARD, BACKWARD = "inertia", "friction forward", "friction backward"


class QuantityStatus(TypedDict):
    """A value of the joint as a share of the model's, with what it may be off by (one standard error) and the interval
    that is certified; `told` once it was beyond it."""

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
    """`judged`: the running set says what joint it is for; `motion_s` is how much motion the shares stand on."""

    judged: bool
    motion_s: float
    joint: list[QuantityStatus]
    errors: list[ErrorStatus]


@dataclass(frozen=True)
class Expected:
    """What a gain set says of the joint that it is certified for."""

    law: LocalGains
    inertia: float
    period_s: float
    late_cycles: int
    slides_rad_s: float
    width: dict[str, float]
    promised: Promise | None
    speed_max_rad_s: float

    @classmethod
    def of(cls, gains: GainSet) -> Expected | None:
        """None for a set that was designed for no joint, or that no certificate stands behind."""
        law, design, certificate = gains.parameters, gains.design, gains.certificate
        if not isinstance(law, LocalParameters) or design is None or certificate is None or not certificate.valid:
            return None
        return cls._of(law, design, certificate.promised)

    @classmethod
    def _of(cls, law: LocalParameters, design: Design, promised: Promise | None) -> Expected:
        model, u = design.model, design.uncertainty
        lag_s = model.actuator_lag.time_constant_s if model.actuator_lag else 0.0
        friction = u.dry + u.viscous
        return cls(
            law.named(),
            model.inertia,
            design.period_s,
            round((model.total_delay_s + lag_s) / design.period_s),
            _SLIDES_SHARE * design.speed_max_rad_s,
            {INERTIA: u.inertia + u.torque_gain, FORWARD: friction, BACKWARD: friction},
            promised,
            design.speed_max_rad_s,
        )

    def friction_nm(self, velocity_rad_s: float) -> float:
        """The friction that the law takes for the joint's when it slides."""
        law = self.law
        decay = max(blended(law.sets, law.shape, velocity_rad_s)[0], law.leak)
        return law.stiffness * velocity_rad_s / decay + law.viscous * velocity_rad_s


class Shares:
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
    last_rad_s: float | None = None


@dataclass
class PromiseWatch:
    """Looks at every record; `see` says in a sentence what is not as certified any more, each thing once."""

    expected: Expected | None = None
    serial: int = -1
    shares: Shares = field(default_factory=Shares)
    motion_s: float = 0.0

    def __post_init__(self) -> None:
        self.begin(self.serial, self.expected)

    def begin(self, serial: int, expected: Expected | None) -> None:
        """Another gain set runs: nothing was seen of its joint yet."""
        self.serial, self.expected, self.shares, self.motion_s = serial, expected, Shares(), 0.0
        self._window, self._errors, self._reference_rad_s, self._cycle = _Window(), _Errors(), 0.0, -1
        self._torques: deque[float] = deque(maxlen=1 + (expected.late_cycles if expected else 0))
        self._beyond = dict.fromkeys((INERTIA, FORWARD, BACKWARD), 0)
        self._told: set[str] = set()
        self._worse: dict[str, deque[bool]] = {}
        self._rms_rad: dict[str, float] = {}

    def see(self, records: Sequence[CycleRecord]) -> list[str]:
        """One sentence for each thing that is not as certified, the first time; for an enabled axis."""
        if self.expected is None:
            return []
        found = []
        for record in records:
            follows, self._cycle = record.cycle == self._cycle + 1, record.cycle
            controlled = record.axis_state == AxisState.ENABLED and record.controller == self.serial
            if not (controlled and follows and record.encoder_age == 0):
                self._interrupt()
                continue
            if told := self._balance(record, self.expected):
                found.append(told)
            if told := self._error(record, self.expected):
                found.append(told)
        return found

    def _interrupt(self) -> None:
        self._torques.clear()
        self._window, self._errors = _Window(), _Errors()

    def _balance(self, record: CycleRecord, e: Expected) -> str:
        """The momentum of the window that ends with this cycle."""
        v, w, torques = record.velocity_rad_s, self._window, self._torques
        torques.append(record.torque_nm - self._known_over_position(record, e))
        way = math.copysign(1.0, v) if abs(v) > e.slides_rad_s else 0.0
        if way == 0.0 or way != w.way or len(torques) <= e.late_cycles:
            self._window = _Window(0, way, v, v)
            return self._close(w, e) if w.cycles * e.period_s >= 0.5 * WINDOW_S else ""
        w.cycles, w.last_rad_s = w.cycles + 1, v
        w.torque += torques[0] * e.period_s
        w.friction += e.friction_nm(v) * e.period_s
        if w.cycles * e.period_s < WINDOW_S:
            return ""
        self._window = _Window(0, way, v, v)
        return self._close(w, e)

    def _close(self, w: _Window, e: Expected) -> str:
        """A whole window, or what the joint left of it when it came to rest."""
        row = [e.inertia * (w.last_rad_s - w.began_rad_s), max(w.friction, 0.0), min(w.friction, 0.0)]
        self.shares.add(row, w.torque, _LEAST_SCATTER * abs(w.friction))
        self.motion_s += w.cycles * e.period_s
        return self._drifted(e)

    def _known_over_position(self, record: CycleRecord, e: Expected) -> float:
        """T(x) of (16), from what the law fed forward: all other torque but the observer's and the inertia's."""
        last, self._reference_rad_s = self._reference_rad_s, record.reference_velocity_rad_s
        if not e.law.knows_position:
            return 0.0
        inertia_nm = e.law.feedforward_inertia * (record.reference_velocity_rad_s - last) / e.period_s
        return record.torque_other_nm - record.disturbance_nm - inertia_nm

    def _drifted(self, e: Expected) -> str:
        texts = []
        for name, share, error in zip(self._beyond, self.shares.values, self.shares.errors, strict=True):
            beyond = abs(share - 1.0) > e.width[name] + _BEYOND + _SIGMAS * error
            self._beyond[name] = self._beyond[name] + 1 if beyond else 0
            if self._beyond[name] >= _STAYS and name not in self._told:
                self._told.add(name)
                texts.append(f"{name} is {share:.2f} times the model's (give or take {2.0 * error:.2f})")
        return "; ".join(texts)

    def _error(self, record: CycleRecord, e: Expected) -> str:
        """RMS error of a window of motion, where the promise speaks of such motion."""
        own, v = self._errors, record.reference_velocity_rad_s
        if e.promised is None or not record.reference_active:
            self._errors = _Errors()
            return ""
        if own.last_rad_s is not None:
            own.acceleration_rad_s2 = max(own.acceleration_rad_s2, abs(v - own.last_rad_s) / e.period_s)
        own.last_rad_s, own.cycles = v, own.cycles + 1
        own.speed_rad_s = max(own.speed_rad_s, abs(v))
        own.squares += (record.reference_rad - record.position_rad) ** 2
        if own.cycles * e.period_s < ERROR_S:
            return ""
        self._errors = _Errors()
        kind, promised_rad = self._kind(own, e, e.promised)
        if not kind:
            return ""
        rms_rad = math.sqrt(own.squares / own.cycles)
        self._rms_rad[kind] = rms_rad
        worse = self._worse.setdefault(kind, deque(maxlen=_LAST_WINDOWS))
        worse.append(rms_rad > _WORSE * promised_rad)
        if sum(worse) < _OF_WINDOWS or kind in self._told:
            return ""
        self._told.add(kind)
        return f"RMS error {1e3 * rms_rad:.3g} mrad in {kind} motion, promised {1e3 * promised_rad:.3g} mrad"

    def _kind(self, own: _Errors, e: Expected, promised: Promise) -> tuple[str, float]:
        """Which sine of the validation motion asks for as much, and what is promised of it."""
        slow = _ROOM * _SLOW_SHARE * e.speed_max_rad_s
        if own.speed_rad_s == 0.0:
            return "", 0.0
        if own.speed_rad_s <= slow and own.acceleration_rad_s2 <= slow * 2.0 * math.pi * _SLOW_HZ:
            return "slow", promised.slow_rad
        brisk, hz = _ROOM * _BRISK_SHARE * e.speed_max_rad_s, min(_BRISK_HZ, 1.0 / (_BRISK_CYCLES * e.period_s))
        if own.speed_rad_s <= brisk and own.acceleration_rad_s2 <= brisk * 2.0 * math.pi * hz:
            return "brisk", max(promised.brisk_rad, promised.slow_rad)
        return "", 0.0

    def status(self) -> PromiseStatus:
        """What was seen so far."""
        e = self.expected
        if e is None:
            return {"judged": False, "motion_s": 0.0, "joint": [], "errors": []}
        joint: list[QuantityStatus] = [
            {
                "name": name,
                "share": share,
                "standard_error": error,
                "certified": [1.0 - e.width[name], 1.0 + e.width[name]],
                "told": name in self._told,
            }
            for name, share, error in zip(self._beyond, self.shares.values, self.shares.errors, strict=True)
        ]
        promised = {} if e.promised is None else {"slow": e.promised.slow_rad, "brisk": e.promised.brisk_rad}
        errors: list[ErrorStatus] = [
            {"kind": kind, "rms_rad": self._rms_rad.get(kind), "promised_rad": rad, "told": kind in self._told}
            for kind, rad in promised.items()
        ]
        return {"judged": True, "motion_s": self.motion_s, "joint": joint, "errors": errors}
