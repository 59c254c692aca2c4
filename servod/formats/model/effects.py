"""Groups of keys of the axis model file for drive, joint, load and encoder, one for each effect; friction's are beside.

Stands between the axis model file and the physics kernels (`servod.kernels.physics`), which obey every group. Torque
means force and rad means m when `axis: linear`. Every group says its equation and source; `servoctl explain` prints it.
"""

from __future__ import annotations

from enum import StrEnum

from pydantic import Field, model_validator

from servod.common.yaml import Strict
from servod.formats.model.keys import Factor, Group, Harmonics, NonNegative, Phase, Positive


class Cogging(Harmonics):
    """Resisting torque sum amplitude*sin(n*x + phase), amplitudes in N*m, independent of the command.

    Source: reluctance of slots against magnets; Hanselman, Brushless Permanent Magnet Motor Design, 2003.
    """

    balanced = True
    plain = True


class TorqueRipple(Harmonics):
    """Torque applied = torque*(1 + sum amplitude*sin(n*x + phase)), amplitudes are shares of the torque.

    Source: back-EMF harmonics and gear transmission error; Jahns and Soong, IEEE TIE 43(2), 1996.
    """

    under_one = 0


class Gravity(Group):
    """Resisting torque amplitude*sin(x + phase): a pendulum. amplitude = m*g*l."""

    balanced = held = True
    plain = True

    amplitude: float = Field(0.0, description="N*m")
    phase: Phase = 0.0


class Spring(Group):
    """Resisting torque stiffness*(x - rest) + cubic*(x - rest)^3: cable, hose, counterbalance, flexure."""

    balanced = held = True

    stiffness: NonNegative = Field(0.0, description="N*m/rad")
    rest: float = Field(0.0, description="position without torque, rad")
    cubic: NonNegative = Field(0.0, description="N*m/rad^3")


class TwoMass(Strict):
    """What stands behind a joint's spring; shares of the model's own `inertia` and `friction.viscous`."""

    load_inertia: Positive = Field(description="kg*m^2, the part of `inertia` that is behind the spring")
    stiffness: Positive = Field(description="N*m/rad")
    damping: NonNegative = Field(0.0, description="N*m*s/rad")
    load_viscous: NonNegative = Field(0.0, description="N*m*s/rad, the part of friction.viscous behind the spring")


class JointElasticity(TwoMass, Group):
    """Motor and load with a spring: tau = k*d + cubic*d^3 + damping*dd/dt, d = x_motor - x_load.

    (J - J_L)*a_motor = u - F(v_motor) - tau; J_L*a_load = tau - load_viscous*v_load - gravity - spring + disturbance.
    The encoder reads the motor. Source: Spong, ASME JDSMC 109(4), 1987; stiffening: Tuttle and Seering 1996.
    """

    cubic: NonNegative = Field(0.0, description="N*m/rad^3, stiffening")


class Backlash(Group):
    """Dead zone before the joint's spring: tau = 0 while |d| < gap/2, else k*(d - sign(d)*gap/2) + damping*dd/dt.

    The other keys say what is behind the gap; beside `joint_elasticity`, which says it, they must not stand.
    Source: Nordin, Galic, Gutman, Int. J. Adaptive Control 11, 1997.
    """

    gap: Positive = Field(description="whole width, rad")
    load_inertia: Positive | None = Field(None, description="kg*m^2, the part of `inertia` behind the gap")
    stiffness: Positive | None = Field(None, description="N*m/rad of the contact")
    damping: NonNegative = Field(0.0, description="N*m*s/rad of the contact")
    load_viscous: NonNegative = Field(0.0, description="N*m*s/rad, the part of friction.viscous behind the gap")


class TorqueGain(Group):
    """Torque = factor*command (k_t, gear or amplifier scale is not what the command assumes)."""

    balanced = True

    factor: Factor = 1.0
    negative_factor: Factor | None = Field(None, description="factor of negative commands, when different")


class LimitShape(StrEnum):
    """How a torque limit is reached."""

    HARD = "hard"
    TANH = "tanh"


class TorqueSaturation(Group):
    """Torque = clip(torque, -negative_limit, limit), or limit*tanh(torque/limit): current limit, iron saturation."""

    balanced = True

    limit: Positive = Field(description="N*m")
    negative_limit: Positive | None = Field(None, description="N*m (a positive number); None = limit")
    shape: LimitShape = LimitShape.HARD


class Delay(Group):
    """Command to torque takes delay_s + additional_s: bus cycles, filters, drive scheduling."""

    balanced = True
    plain = True

    additional_s: float = Field(ge=-0.001, le=0.25)


class ActuatorLag(Group):
    """Torque follows the delayed command by dT/dt = (command - T)/time_constant_s, at most slew_per_s."""

    balanced = True

    time_constant_s: NonNegative = Field(0.0, le=1.0)
    slew_per_s: Positive | None = Field(None, description="N*m/s")


class PositionDependentInertia(Harmonics):
    """M(x) = inertia*(1 + sum amplitude*sin(n*x + phase)), with M*a + dM/dx*v^2/2 = torque; amplitudes are shares.

    Behind a joint's spring or gap it is the load that varies: shares of load_inertia over the load's position.
    Source: Lagrange's equation of a linkage, crank or eccentric load.
    """

    under_one = 0


class EncoderEccentricity(Harmonics):
    """Encoder = x + sum amplitude*sin(n*x + phase), amplitudes in rad: the disc is off its axis (n = 1) or oval."""

    plain = True
    under_one = 1


class DisturbanceWindow(Strict):
    """An external torque from start_s to end_s: torque*cos(2*pi*frequency_hz*(t - start_s) + phase)."""

    start_s: float
    end_s: float
    torque: float = Field(description="N*m, with the command's sign")
    frequency_hz: NonNegative = 0.0
    phase: Phase = 0.0

    @model_validator(mode="after")
    def _window(self) -> DisturbanceWindow:
        if self.start_s >= self.end_s:
            raise ValueError("start_s less than end_s")
        return self


class Disturbance(Group):
    """External torques, each in a time window of the recording (t_s): somebody leans on the axis, a cable catches."""

    windows: tuple[DisturbanceWindow, ...] = Field(min_length=1, max_length=64)


class OffsetDrift(Group):
    """The torque offset drifts: torque += per_s*t, or per_s*time_s*(1 - exp(-t/time_s)) when time_s is given.

    t counts from the first row of a recording, from power-on in a virtual axis. Source: offset of a current sensor or
    amplifier that warms up (data sheets: offset drift); a counterbalance that leaks; a cable that settles.
    """

    plain = True

    per_s: float = Field(description="N*m/s at the first row, with the command's sign")
    time_s: Positive | None = Field(None, description="s in which the drift ends; None = it goes on")


class TorqueMap(Strict):
    """A resisting torque as a piecewise linear function, zero outside its grid."""

    grid: tuple[float, ...] = Field(min_length=2, max_length=2048, description="ascending: rad, rad/s or s")
    torque: tuple[float, ...] = Field(min_length=2, max_length=2048, description="N*m")

    @model_validator(mode="after")
    def _is_a_function(self) -> TorqueMap:
        if len(self.grid) != len(self.torque):
            raise ValueError("as many torques as grid points")
        if any(a >= b for a, b in zip(self.grid, self.grid[1:], strict=False)):
            raise ValueError("an ascending grid")
        return self


class Residual(Group):
    """A resisting torque that fits no known physics, kept as a table over position, velocity or time where it lives."""

    position: TorqueMap | None = None
    velocity: TorqueMap | None = None
    time: TorqueMap | None = None


class Noise(Strict):
    """What a virtual plant adds: torque noise (first-order low-passed white noise), encoder noise, temperature."""

    torque_rms: NonNegative = Field(0.0, description="N*m")
    torque_bandwidth_hz: Positive = Field(100.0, description="Hz")
    encoder_rms: NonNegative = Field(0.0, description="rad, at each reading")
    temperature_c: float | None = Field(None, ge=-100.0, le=300.0, description="degC at the start; None = ambient")
    temperature_rms_c: NonNegative = Field(0.0, description="degC, at each reading")
