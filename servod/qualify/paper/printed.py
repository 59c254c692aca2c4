"""What the paper prints: Table I, the RMS errors of section V, and the settings of its runs.

Under everything of `paper`. Numbers are as printed; where the text and its own equations disagree, the reading that is
used stands beside.
"""

from __future__ import annotations

from typing import NamedTuple

#: RMS error of trajectory (19) on the laboratory joint, in mrad.
RMS_MRAD = {"pd_dob": 0.6916, "pd_lugre": 0.5006, "local": 0.3781}

#: Sinusoidal reference of the simulations (Fig. 9 to 12); its amplitude is not printed, 0.1 rad is that of (19).
SINE_HZ, SINE_RAD = 0.1, 0.1
#: Steps of section V.
STEPS_MRAD = (100.0, 10.0)

#: K_i of Table I for the seven inner sets v_i = -0.2 to 0.12 rad/s; read as l_i, none at the outer two.
L_I = (0.0, 0.0, -0.5, -1.5, -2.5, -1.5, 0.5, 0.0, 0.0)
#: v_i of Table I [rad/s].
NODES_RAD_S = (-0.5, -0.2, -0.01, -0.001, 0.0, 0.001, 0.05, 0.12, 0.5)

#: PD gains of Table I: K_P [N*m/rad] and K_D [N*m*s/rad].
K_P, K_D = 2.5, 0.12


class Friction(NamedTuple):
    """Friction of Table I in N*m, N*m*s/rad, rad/s and N*m/rad."""

    static: float
    coulomb: float
    viscous: float
    stribeck_velocity: float
    sigma0: float
    sigma1: float


FRICTION = Friction(0.07, 0.045, 0.056, 0.1, 950.0, 1.0)
INERTIA = 0.001


class PrintedGains(NamedTuple):
    """Three gains as printed for one region, in the printed order."""

    first: float
    second: float
    third: float


#: "K_v, K_v, K_z" of Table I.
GAINS_LOW, GAINS_HIGH = PrintedGains(0.017, 0.241, 1574.9), PrintedGains(21.615, 2.104, 197.0)
