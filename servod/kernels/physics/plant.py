"""The plant of a virtual axis: an axis model that moves, with noise, driven by torque over any span of time.

Used by the virtual drive and encoder (`servod.drivers.virtual`), which read it but never its model. Inner steps of a
fixed length; compiled when numba is installed, the same source in pure Python otherwise, with the same result.
"""

from __future__ import annotations

import math
import random
from collections.abc import MutableSequence
from functools import partial
from typing import Any, Protocol

from servod.kernels.physics.compiled import Kernel, arrays, available, entry, record
from servod.kernels.physics.dynamics import advance
from servod.kernels.physics.effects import encoder_position
from servod.kernels.physics.layout import PackedPlant, PlantParameters, PlantRecord, PlantState, Tables

#: Inner step of every simulation, s (stiff bristles and springs of real joints need 50 us or less).
INNER_STEP_S = 50e-6


def delay_line_length(delay_s: float, step_s: float) -> int:
    """Values that the delay line must hold for a delay: whole steps, one for the fraction, one being written."""
    return math.ceil(delay_s / step_s + 1e-9) + 2


def delay_line(delay_s: float, step_s: float) -> list[float]:
    """The command delay line of an axis without torque."""
    return [0.0] * delay_line_length(delay_s, step_s)


def inputs(packed: PackedPlant, state: PlantState, *, bare: bool = False) -> tuple[Any, ...]:
    """A packed model and a state for kernels that are compiled where they can be, which take them first.

    They come as one record in an array of one, as `compiled.entry` wants them; `bare` for a kernel that is called once
    for a whole motion: it takes 26 us more to call, and no second kernel around it to compile.
    """
    if not available():
        return packed.p, packed.tables, state
    tables = arrays(packed.tables)
    if bare:
        return record(packed.p).memory[0], tables, record(state).memory[0]
    return record(PlantRecord(packed.p, state)).memory, tables


class PlantNoise(Protocol):
    """What disturbs a plant, as RMS; the torque's noise is low-passed."""

    @property
    def torque_rms(self) -> float:
        """N*m."""

    @property
    def torque_bandwidth_hz(self) -> float:
        """Hz."""

    @property
    def encoder_rms(self) -> float:
        """rad, at each reading."""

    @property
    def temperature_rms_c(self) -> float:
        """degC, at each reading."""


class PlantModel(Protocol):
    """What a plant asks of an axis model: its parameters, and what is not among them."""

    @property
    def noise(self) -> PlantNoise | None:
        """Noise of torque and readings; None for a plant without."""

    @property
    def total_delay_s(self) -> float:
        """Command to torque, s."""

    @property
    def start_temperature_c(self) -> float:
        """Temperature of the joint before it moves, degC."""

    def pack(self) -> PackedPlant:
        """The parameters by name, and the rows of their tables."""


def encoder_reading(p: PlantParameters, tables: Tables, s: PlantState, owed_s: float) -> float:
    """What an ideal encoder shows `owed_s` after the last inner step."""
    return encoder_position(p, tables, s.position + owed_s * s.velocity)


def advance_held(
    p: PlantParameters,
    tables: Tables,
    s: PlantState,
    line: MutableSequence[float],
    command: float,
    external: float,
    steps: int,
) -> None:
    """`advance` with the plant's own step, delay and heating; to take each of them from Python costs numba 15 ns."""
    advance(p, tables, s, line, command, external, steps, INNER_STEP_S, p.delay_s, math.nan)


class Plant:
    """One joint in motion; all values SI in joint coordinates.

    `delay_s` overrides the model's command-to-torque time (a drive on a bus has part of it already). The same model,
    seed and calls give the same motion.
    """

    def __init__(
        self, model: PlantModel, seed: int = 0, *, delay_s: float | None = None, compile_kernel: bool | None = None
    ) -> None:
        self.model = model
        self.delay_s = model.total_delay_s if delay_s is None else max(0.0, delay_s)
        self._gauss = random.Random(seed).gauss  # noqa: S311  (noise, not secrets)
        noise = model.noise
        self._torque_rms = noise.torque_rms if noise else 0.0
        self._torque_decay_per_s = -2.0 * math.pi * noise.torque_bandwidth_hz if noise else 0.0
        self._encoder_rms = noise.encoder_rms if noise else 0.0
        self._temperature_rms_c = noise.temperature_rms_c if noise else 0.0
        self._noise_torque_nm = 0.0
        self._owed_s = 0.0
        self._bind(model.pack(), available() if compile_kernel is None else compile_kernel)
        self._draw_readings()

    def _bind(self, packed: PackedPlant, compile_kernel: bool) -> None:
        """Set the kernels up, with what they take at every call bound to them: 0.1 us less than to hand it over."""
        self._s: Any = PlantState(temperature_c=self.model.start_temperature_c)
        p = packed.p._replace(delay_s=self.delay_s)
        axis: tuple[Any, ...] = p, packed.tables, self._s
        line: Any = delay_line(self.delay_s, INNER_STEP_S)
        kernels: tuple[Kernel, Kernel] = advance_held, encoder_reading
        if compile_kernel:
            import numpy as np

            names, memory = record(PlantRecord(p, self._s))
            self._s, axis, line = names.s, (memory, arrays(packed.tables)), np.array(line)
            kernels = entry(advance_held), entry(encoder_reading)
        self._advance, self._encoder = partial(kernels[0], *axis, line), partial(kernels[1], *axis)
        self._eccentric = p.eccentricity_n > 0
        if compile_kernel:
            self._advance(0.0, 0.0, 0)
            self._encoder(0.0)

    def advance(self, torque_nm: float, duration_s: float, external_nm: float = 0.0) -> None:
        """Let `duration_s` pass under the held command `torque_nm`; `external_nm` acts beside it without delay.

        Spans that are no multiple of the inner step leave a remainder, which the next call makes up.
        """
        owed_s = self._owed_s + duration_s
        steps = int(owed_s / INNER_STEP_S + 1e-6)
        self._owed_s = owed_s - steps * INNER_STEP_S
        if self._torque_rms > 0.0:  # low-passed white torque noise: Ornstein-Uhlenbeck, exact over the span
            kept = math.exp(self._torque_decay_per_s * duration_s)
            fresh = self._torque_rms * math.sqrt(1.0 - kept * kept)
            self._noise_torque_nm = noise_nm = kept * self._noise_torque_nm + fresh * self._gauss(0.0, 1.0)
            external_nm += noise_nm
        self._advance(torque_nm, external_nm, steps)
        self._draw_readings()

    def place(self, position_rad: float, velocity_rad_s: float = 0.0) -> None:
        """Put the joint somewhere, bristle relaxed; motor and load together."""
        self._s.position = self._s.load_position = position_rad
        self._s.velocity = self._s.load_velocity = velocity_rad_s
        self._s.bristle = 0.0

    def _draw_readings(self) -> None:
        """Reading noise, once per span, so that a reading stays the same until time passes."""
        gauss, encoder, temperature = self._gauss, self._encoder_rms, self._temperature_rms_c
        self._encoder_noise_rad = gauss(0.0, encoder) if encoder else 0.0
        self._temperature_noise_c = gauss(0.0, temperature) if temperature else 0.0

    @property
    def position_rad(self) -> float:
        """True joint position: the load's where the joint is elastic or has a gap."""
        return float(self._s.load_position) + self._owed_s * float(self._s.load_velocity)

    @property
    def velocity_rad_s(self) -> float:
        """True joint velocity, load side."""
        return float(self._s.load_velocity)

    @property
    def motor_position_rad(self) -> float:
        """True position of the motor side, in joint coordinates."""
        return float(self._s.position) + self._owed_s * float(self._s.velocity)

    @property
    def motor_velocity_rad_s(self) -> float:
        """True velocity of the motor side, in joint coordinates."""
        return float(self._s.velocity)

    @property
    def encoder_position_rad(self) -> float:
        """What the encoder on the motor side sees before counting: eccentricity and reading noise included."""
        shown = float(self._encoder(self._owed_s)) if self._eccentric else self.motor_position_rad
        return shown + self._encoder_noise_rad

    @property
    def temperature_c(self) -> float:
        """Measured joint temperature, reading noise included."""
        return float(self._s.temperature_c) + self._temperature_noise_c

    @property
    def friction_nm(self) -> float:
        """True friction torque of the last inner step."""
        return float(self._s.friction)

    @property
    def time_s(self) -> float:
        """Time that has passed since the start."""
        return float(self._s.time_s) + self._owed_s
