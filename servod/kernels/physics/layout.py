"""Where each number stands in the flat parameter tuple and the flat state list that the physics kernels work on.

Stands under every kernel of `servod.kernels.physics`: the kernels are plain functions on `p[i]` and `s[i]`, so that the
same source runs in pure Python (tuple, list) and compiled (float64 arrays). `servod.formats.model.pack` fills `p` from
an axis model. SI units in joint coordinates throughout; for a linear axis read N for N*m, m for rad, kg for kg*m^2.
"""

from __future__ import annotations

# --- parameters: the fixed part of p -----------------------------------------------------------------------------
(
    P_INERTIA,  # motor side; the whole inertia when there is one mass
    P_SIGMA0,  # bristle stiffness; 0 = no presliding, set-valued Coulomb friction
    P_SIGMA1,
    P_SIGMA1_VELOCITY,  # 0 = bristle damping does not fade with speed
    P_VISCOUS,  # motor side
    P_COULOMB,
    P_STATIC,
    P_STRIBECK_VELOCITY,
    P_STRIBECK_EXPONENT,
    P_GRAVITY,
    P_GRAVITY_PHASE,
    P_OFFSET,
    P_OFFSET_PER_S,  # 0 = the offset does not drift
    P_OFFSET_TIME_S,  # 0 = its drift has no end
    P_DELAY_S,
    P_COMPLEX,  # 1 = some effect is present that the plain loop leaves out
    P_POSITIVE_DRY,  # factors of dry and viscous friction by direction
    P_NEGATIVE_DRY,
    P_POSITIVE_VISCOUS,
    P_NEGATIVE_VISCOUS,
    P_QUADRATIC,
    P_CUBIC,
    P_POWER,
    P_POWER_EXPONENT,
    P_FRICTION_PER_COMMAND,
    P_FRICTION_PER_LOAD,
    P_SPRING,
    P_SPRING_REST,
    P_SPRING_CUBIC,
    P_LOAD_INERTIA,  # 0 = one mass
    P_STIFFNESS,
    P_STIFFNESS_CUBIC,
    P_DAMPING,
    P_LOAD_VISCOUS,  # of the whole viscous friction, the part behind the joint's spring
    P_GAP,
    P_GAIN_POSITIVE,
    P_GAIN_NEGATIVE,
    P_LIMIT_POSITIVE,  # 0 = no limit
    P_LIMIT_NEGATIVE,
    P_LIMIT_SOFT,
    P_LAG_S,
    P_SLEW,  # 0 = no limit of the torque's rate
    P_THERMAL,
    P_DRY_PER_C,
    P_VISCOUS_PER_C,
    P_REFERENCE_C,
    P_THERMAL_EXPONENTIAL,
    P_AMBIENT_C,
    P_HEATING_C_PER_J,
    P_COOLING_S,
    P_DRY_PER_S,
    P_VISCOUS_PER_S,
    P_DRIFT_TIME_S,
    P_START_C,  # temperature before the first step where none is recorded
    # tables behind the fixed part: first index and number of rows
    P_COGGING,
    P_COGGING_N,
    P_RIPPLE,
    P_RIPPLE_N,
    P_POSITION_FRICTION,
    P_POSITION_FRICTION_N,
    P_BUMPS,
    P_BUMPS_N,
    P_POSITION_INERTIA,
    P_POSITION_INERTIA_N,
    P_ECCENTRICITY,
    P_ECCENTRICITY_N,
    P_DISTURBANCE,
    P_DISTURBANCE_N,
    P_LOCAL_POSITIVE,
    P_LOCAL_POSITIVE_N,
    P_LOCAL_NEGATIVE,
    P_LOCAL_NEGATIVE_N,
    P_RESIDUAL_POSITION,
    P_RESIDUAL_POSITION_N,
    P_RESIDUAL_VELOCITY,
    P_RESIDUAL_VELOCITY_N,
    P_RESIDUAL_TIME,
    P_RESIDUAL_TIME_N,
    P_SIZE,
) = range(79)

# --- states: the fixed part of s, then the command delay line ----------------------------------------------------
(
    S_POSITION,  # motor side
    S_VELOCITY,
    S_BRISTLE,  # z, rad
    S_LOAD_POSITION,  # follows the motor when there is one mass
    S_LOAD_VELOCITY,
    S_TORQUE,  # torque behind actuator lag and limits, before ripple
    S_TEMPERATURE_C,
    S_TIME_S,
    S_FIRST_S,  # time of the first step: drifts count from here, t_s of a recording may count from 1970
    S_FRICTION,  # friction torque of the last step
    S_HEAD,  # where the delay line is written next
    S_LINE,  # first value of the delay line; its length is len(s) - S_LINE
) = range(12)
