"""Groups of keys of the axis model file for what plain friction laws leave out, one for each effect.

Beside `effects`, which has the groups of everything that is no friction. Every group says its equation and source.
"""

from __future__ import annotations

from enum import StrEnum

from pydantic import Field

from servod.common.yaml import Strict
from servod.formats.model.keys import Factor, Group, Harmonic, NonNegative, Positive


class Asymmetry(Group):
    """Friction differs by direction: g(v) and the viscous term are multiplied by a factor for the sign of v.

    g(v) -> k(sign v)*g(v), F_v -> k_v(sign v)*F_v. Source: the paper's II-B, maps signed per direction;
    Armstrong-Helouvry, Dupont, Canudas de Wit, Automatica 30(7), 1994.
    """

    balanced = True
    plain = True

    positive_dry: Factor = Field(1.0, description="factor of Coulomb and static friction for v > 0")
    negative_dry: Factor = Field(1.0, description="factor of Coulomb and static friction for v < 0")
    positive_viscous: Factor = Field(1.0, description="factor of viscous friction for v > 0")
    negative_viscous: Factor = Field(1.0, description="factor of viscous friction for v < 0")


class Stribeck(Group):
    """Stribeck curve: g(v) = F_C + (F_S - F_C)*exp(-(|v|/v_s)^exponent); keys given here replace those of `friction`.

    Not with friction of kind local, whose map has the curve in it.
    Source: the paper's (18) with the exponent's sign mended; exponent by Bo and Pavelescu, Wear 82, 1982.
    """

    balanced = True
    plain = True

    static: NonNegative | None = Field(None, description="F_S, N*m")
    stribeck_velocity: Positive | None = Field(None, description="v_s, rad/s")
    exponent: float = Field(2.0, ge=0.2, le=10.0, description="shape; 2 is the paper's, 1 is Tustin's")


class Presliding(Group):
    """Bristle: dz/dt = v - sigma0*|v|/g(v)*z, F = sigma0*z + sigma1(v)*dz/dt; keys given here replace `friction`'s.

    sigma1(v) = sigma1*exp(-(v/damping_velocity)^2) when damping_velocity is given. Source: Canudas de Wit et al.,
    IEEE TAC 40(3), 1995 (LuGre); Olsson 1996 for the fading damping.
    """

    plain = True

    sigma0: Positive | None = Field(None, description="stiffness, N*m/rad")
    sigma1: NonNegative | None = Field(None, description="damping, N*m*s/rad")
    damping_velocity: Positive | None = Field(None, description="rad/s at which the damping fades")


class ViscousNonlinear(Group):
    """Viscous friction that is not a line: + quadratic*|v|*v + cubic*v^3 + power*sign(v)*|v|^exponent.

    Source: Kruif, Gautier and others fit drives with |v|^n; churning losses are quadratic, greases thin (n < 1).
    """

    balanced = True

    quadratic: float = Field(0.0, description="N*m*s^2/rad^2")
    cubic: float = Field(0.0, description="N*m*s^3/rad^3")
    power: float = Field(0.0, description="N*m*(s/rad)^exponent")
    exponent: float = Field(0.5, gt=0.0, le=5.0)


class LoadDependentFriction(Group):
    """Dry friction grows with what the gears carry: g -> g + per_command*|torque| + per_load*|load torque|.

    Load torque is gravity + spring + disturbance. Source: Hamon, Gautier, Garrec, IROS 2010; BAM (Duclusaud 2024).
    """

    per_command: NonNegative = Field(0.0, le=10.0, description="N*m of friction per N*m of applied torque")
    per_load: NonNegative = Field(0.0, le=10.0, description="N*m of friction per N*m of load torque")


class Bump(Strict):
    """A tight spot: a Gaussian over position that adds `factor` to the factor of dry friction."""

    position: float = Field(description="centre, rad")
    width: Positive = Field(description="standard deviation, rad")
    factor: float = Field(ge=-1.0, le=100.0, description="share of dry friction at the centre")


class PositionDependentFriction(Group):
    """Dry friction times 1 + sum amplitude*sin(n*x + phase) + sum factor*exp(-(x - position)^2/(2*width^2)).

    Never below 5 % of its plain value. Amplitudes are shares (1 = 100 %). Source: gear mesh and bearing preload;
    Armstrong-Helouvry 1991 (position dependence of PUMA friction).
    """

    harmonics: tuple[Harmonic, ...] = Field((), max_length=64)
    bumps: tuple[Bump, ...] = Field((), max_length=64)

    @property
    def waves(self) -> tuple[Harmonic, ...]:
        """Those of its factor."""
        return self.harmonics


class ThermalShape(StrEnum):
    """How friction depends on temperature."""

    LINEAR = "linear"
    EXPONENTIAL = "exponential"


class Thermal(Group):
    """Friction changes with temperature T or time t: dry and viscous friction are multiplied by a factor each.

    linear: 1 + k*(T - reference_c); exponential: exp(k*(T - reference_c)); k is negative for a joint that loosens when
    warm. Time: + k_t*t, or k_t*time_s*(1 - exp(-t/time_s)) when drift_time_s is given. Factors stay above 0.05.
    t counts from the first row of a recording, from power-on in a virtual axis.
    T is the recorded temperature where there is one, else dT/dt = heating_c_per_j*|F*v| - (T - ambient_c)/cooling_s.
    Source: Bittencourt and Gunnarsson, ASME JDSMC 134(5), 2012; Simoni et al., IROS 2015.
    """

    balanced = True
    plain = True

    dry_per_c: float = Field(0.0, ge=-1.0, le=1.0, description="1/degC")
    viscous_per_c: float = Field(0.0, ge=-1.0, le=1.0, description="1/degC")
    reference_c: float = Field(25.0, ge=-100.0, le=300.0, description="degC at which `friction` holds")
    shape: ThermalShape = ThermalShape.LINEAR
    dry_per_s: float = Field(0.0, ge=-10.0, le=10.0, description="1/s")
    viscous_per_s: float = Field(0.0, ge=-10.0, le=10.0, description="1/s")
    drift_time_s: Positive | None = Field(None, description="s in which the drift ends; None = it goes on")
    ambient_c: float = Field(25.0, ge=-100.0, le=300.0, description="degC")
    heating_c_per_j: NonNegative = Field(0.0, description="degC per J of friction loss")
    cooling_s: Positive = Field(600.0, description="time constant, s")
