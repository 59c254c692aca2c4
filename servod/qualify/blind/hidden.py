"""What an axis of the trial may conceal: every name of the outside contract, in a textbook form and in another one.

Stands on axes and physics. `HIDE` maps a name to the function that draws it; the drawings stand in `hidden_friction`,
`hidden_place` and `hidden_drive`, physics that is on nobody's list in `unlisted`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from servod.qualify.blind import listed
from servod.qualify.blind.concealed import NO_THERMOMETER, Concealed, Document, Draw

# --- Between command and load ----------------------------------------------------------------------------------------
# Draws what is concealed between command and load: the drive's faults, elasticity, inertia, and torques from outside.


def backlash(draw: Draw) -> Concealed:
    """A gap before a stiff contact; otherwise a contact that stiffens and hardly damps."""
    p = draw.physics
    load = draw.between(0.45, 0.7) * p.inertia
    motor = p.inertia - load
    gap = draw.size(0.003, 0.008) * draw.axis.motions.travel
    stiffness = (2.0 * math.pi * draw.between(60.0, 110.0)) ** 2 * load * motor / p.inertia
    damping = (0.15 if draw.other else 0.5) * 2.0 * math.sqrt(stiffness * load * motor / p.inertia)
    changes = _split(draw, load) | {"joint_gap": gap, "joint_stiffness": stiffness, "joint_damping": damping}
    if draw.other:
        changes["joint_cubic"] = 2.0 * stiffness / gap**2
    group = {"gap": gap, "load_inertia": load, "stiffness": stiffness, "damping": damping}
    parameters = {"gap": gap, "load_inertia": load}
    believed = {"inertia": p.inertia, "viscous": p.viscous}
    model = None if draw.other else {listed.BACKLASH: group | {"load_viscous": changes["load_viscous"]}}
    return Concealed(changes, parameters, model, believed)


def joint_elasticity(draw: Draw) -> Concealed:
    """A soft joint; otherwise one that stiffens with its stretch."""
    p = draw.physics
    load = draw.between(0.4, 0.7) * p.inertia
    motor = p.inertia - load
    weak = 2.0 * math.pi * max(14.0 / math.sqrt(draw.strength), 5.0) * draw.between(0.8, 1.5)
    stiffness = weak**2 * load
    damping = draw.between(0.02, 0.06) * 2.0 * math.sqrt(stiffness * load * motor / p.inertia)
    bend = 0.2 * draw.axis.effort / stiffness
    cubic = 0.5 * stiffness / bend**2 if draw.other else 0.0
    changes = _split(draw, load) | {"joint_stiffness": stiffness, "joint_damping": damping, "joint_cubic": cubic}
    group = {"load_inertia": load, "stiffness": stiffness, "damping": damping, "cubic": cubic}
    parameters = {"load_inertia": load, "stiffness": stiffness}
    believed = {"inertia": p.inertia, "viscous": p.viscous}
    model = {listed.JOINT_ELASTICITY: group | {"load_viscous": changes["load_viscous"]}}
    return Concealed(changes, parameters, model, believed)


def _split(draw: Draw, load: float) -> dict[str, float]:
    """One mass made two: `load` of the inertia and a tenth to a fifth of the viscous friction behind the joint."""
    p, share = draw.physics, draw.between(0.1, 0.2)
    return {
        "inertia": p.inertia - load,
        "load_inertia": load,
        "viscous": (1.0 - share) * p.viscous,
        "load_viscous": share * p.viscous,
    }


def torque_gain(draw: Draw) -> Concealed:
    """More or less torque than the command says; otherwise by the command's sign."""
    off = 0.12 + min(draw.size(0.03, 0.15), 0.4)
    factor = 1.0 + off if draw.flip() else 1.0 / (1.0 + off)
    back = factor * draw.one_of(0.94, 1.06) if draw.other else factor
    group = {"factor": factor} | ({"negative_factor": back} if draw.other else {})
    return Concealed({"gain_front": factor, "gain_back": back}, group, {listed.TORQUE_GAIN: group})


def torque_saturation(draw: Draw) -> Concealed:
    """A hard limit that the faster motions meet; otherwise iron that saturates."""
    share = max(0.62 / draw.strength**0.5, 0.25) * draw.between(0.85, 1.15)
    limit = share * draw.axis.effort * (1.25 if draw.other else 1.0)
    group = {"limit": limit}
    model = {listed.TORQUE_SATURATION: {"limit": limit, "shape": "tanh" if draw.other else "hard"}}
    return Concealed({"limit": limit, "limit_shape": float(draw.other)}, group, model)


def delay(draw: Draw) -> Concealed:
    """A longer dead time; otherwise with a little lag as well."""
    more = round(1e3 * (0.0025 + min(draw.size(0.001, 0.004), 0.009)), 1) * 1e-3
    lag = 0.1 * more if draw.other else 0.0
    changes = {"delay_s": draw.physics.delay_s + more, "lag_s": lag}
    model = {listed.DELAY: {"additional_s": more}} | (
        {listed.ACTUATOR_LAG: {"time_constant_s": lag}} if draw.other else {}
    )
    return Concealed(changes, {"additional_s": more + lag}, model)


def actuator_lag(draw: Draw) -> Concealed:
    """A lag of first order; otherwise of second order or a limited rate."""
    lag = min(draw.size(0.003, 0.008), 0.02)
    if draw.other and draw.flip():
        slew = draw.axis.effort * 2.0 * math.pi * 2.0 * draw.axis.motions.tempo / max(draw.strength, 1.0)
        return Concealed({"slew": slew}, {"slew_per_s": slew}, {listed.ACTUATOR_LAG: {"slew_per_s": slew}})
    found = {"time_constant_s": lag}
    order = 2.0 if draw.other else 1.0
    return Concealed({"lag_s": lag, "lag_order": order}, found, None if draw.other else {listed.ACTUATOR_LAG: found})


def inertia(draw: Draw) -> Concealed:
    """Another mass than believed, by more than a tenth."""
    off = 0.15 + min(draw.size(0.05, 0.3), 0.8)
    own = draw.physics.inertia
    there = own * (1.0 + off) if draw.flip() else own / (1.0 + off)
    return Concealed({"inertia": there}, {"inertia": there}, {}, {"inertia": own})


def torque_offset(draw: Draw) -> Concealed:
    """A constant torque beside the command."""
    torque = draw.size(0.08, 0.35) * draw.physics.coulomb * draw.sign()
    return Concealed({"offset": torque}, {listed.TORQUE_OFFSET: torque}, {listed.TORQUE_OFFSET: torque})


def disturbance(draw: Draw) -> Concealed:
    """A push for a second or two in one recording; otherwise one that swells."""
    torque, start = draw.size(0.3, 1.0) * draw.physics.coulomb * draw.sign(), draw.between(2.0, 9.0)
    lasts, shape = draw.between(0.8, 3.0), draw.one_of(1.0, 2.0) if draw.other else 0.0
    changes = {"push": torque, "push_start_s": start, "push_end_s": start + lasts, "push_shape": shape}
    parameters = {} if draw.other else {"start_s": start, "end_s": start + lasts, "torque": torque}
    return Concealed(changes, parameters, None if draw.other else {}, only=int(draw.one_of(0.0, 1.0, 2.0)))


# --- Over position ---------------------------------------------------------------------------------------------------
# Draws what is concealed over position: periodic torques, weights, springs, inertia, and an encoder off its axis. What
# repeats along the way repeats at least PERIODS times in the range.


#: Least periods in the range of whatever is periodic in position.
PERIODS = 1.6


def position_dependent_friction(draw: Draw) -> Concealed:
    """A sine over position; otherwise a tight spot or a triangle."""
    share = min(draw.size(0.12, 0.35), 0.8)
    if draw.other and draw.flip():
        travel = draw.axis.motions.travel
        spot = {"factor": min(2.0 * share, 2.0), "position": draw.between(-0.4, 0.4) * travel, "width": 0.13 * travel}
        changes = {"spot_share": spot["factor"], "spot_place": spot["position"], "spot_width": spot["width"]}
        return Concealed(changes, spot, {listed.POSITION_DEPENDENT_FRICTION: {"bumps": [spot]}})
    order, phase = _order(draw, 2.0, 6.0), draw.between(0.0, 6.28)
    changes = {"grip_share": share, "grip_order": order, "grip_phase": phase, "grip_shape": _shape(draw)}
    return _periodic(draw, listed.POSITION_DEPENDENT_FRICTION, changes, order, share, phase)


def cogging(draw: Draw) -> Concealed:
    """A sine of some order with a weak second; otherwise a triangle or a leaning wave."""
    torque = draw.size(0.1, 0.5) * draw.physics.coulomb
    order, phase = _order(draw, 3.0, 9.0), draw.between(0.0, 6.28)
    second = torque * draw.between(0.0, 0.15)
    changes = {"cogging": torque, "cogging_order": order, "cogging_phase": phase}
    changes |= {"cogging_second": second, "cogging_shape": _shape(draw)}
    return _periodic(draw, listed.COGGING, changes, order, torque, phase, second)


def torque_ripple(draw: Draw) -> Concealed:
    """A share of the torque that goes with a sine of position; otherwise with another wave."""
    share = min(draw.size(0.06, 0.2), 0.45)
    order, phase = _order(draw, 2.5, 8.0), draw.between(0.0, 6.28)
    changes = {"ripple_share": share, "ripple_order": order, "ripple_phase": phase, "ripple_shape": _shape(draw)}
    return _periodic(draw, listed.TORQUE_RIPPLE, changes, order, share, phase)


def gravity(draw: Draw) -> Concealed:
    """A weight that nobody told of; otherwise on a linkage. Beside a known weight, the sum of both is to be found."""
    p = draw.physics
    torque, phase = draw.size(0.3, 1.5) * p.coulomb, draw.between(0.0, 6.28)
    sine = p.gravity * math.cos(p.gravity_phase) + torque * math.cos(phase)
    cosine = p.gravity * math.sin(p.gravity_phase) + torque * math.sin(phase)
    amplitude, turned = math.hypot(sine, cosine), math.atan2(cosine, sine)
    second = 0.12 * torque if draw.other else 0.0
    changes = {"gravity": amplitude, "gravity_phase": turned, "gravity_second": second}
    found = {"amplitude": amplitude, "phase": turned}
    believed = {"gravity": p.gravity, "gravity_phase": p.gravity_phase}
    return Concealed(changes, found, None if draw.other else {listed.GRAVITY: found}, believed, travel=0.9)


def spring(draw: Draw) -> Concealed:
    """A straight spring; otherwise one that stiffens or has some slack in the middle."""
    travel = draw.axis.motions.travel
    torque, rest = draw.size(0.4, 1.8) * draw.physics.coulomb, draw.between(-0.4, 0.4) * travel
    stiffness = torque / travel
    if draw.other and draw.flip():
        return Concealed({"spring": stiffness, "spring_rest": rest, "spring_slack": 0.1 * travel}, travel=1.2)
    cubic = 0.8 * stiffness / travel**2 if draw.other else 0.0
    found = {"stiffness": stiffness, "rest": rest, "cubic": cubic}
    changes = {"spring": stiffness, "spring_rest": rest, "spring_cubic": cubic}
    parameters = found if draw.other else {key: found[key] for key in ("stiffness", "rest")}
    return Concealed(changes, parameters, {listed.SPRING: found}, travel=0.9 if draw.other else 1.2)


def position_dependent_inertia(draw: Draw) -> Concealed:
    """Inertia with a sine of some periods a turn; otherwise a crank's, with a second harmonic."""
    share, order = min(draw.size(0.15, 0.35), 0.6), draw.one_of(2.0, 3.0)
    phase, second = draw.between(0.0, 6.28), 0.2 * share if draw.other else 0.0
    changes = {"swing_share": share, "swing_order": order, "swing_phase": phase, "swing_second": second}
    rows = _rows(order, share, phase, second)
    travel = PERIODS * math.pi / order
    return Concealed(changes, _first(rows), {listed.POSITION_DEPENDENT_INERTIA: {"harmonics": rows}}, travel=travel)


def encoder_eccentricity(draw: Draw) -> Concealed:
    """A disc off its axis or oval; otherwise both."""
    order, phase = draw.one_of(1.0, 2.0), draw.between(0.0, 6.28)
    amplitude = min(draw.size(0.01, 0.03), 0.12) / order
    second = 0.15 * amplitude if draw.other else 0.0
    changes = {"eccentricity": amplitude, "eccentricity_order": order, "eccentricity_phase": phase}
    changes["eccentricity_second"] = second
    rows = _rows(order, amplitude, phase, second)
    travel = PERIODS * math.pi / order
    return Concealed(changes, _first(rows), {listed.ENCODER_ECCENTRICITY: {"harmonics": rows}}, travel=travel)


def _order(draw: Draw, least: float, most: float) -> float:
    """Whole periods in a turn, of which between `least` and `most` are in the range."""
    turns = 2.0 * draw.axis.motions.travel / (2.0 * math.pi)
    return max(float(round(draw.between(least, most) / turns)), math.ceil(PERIODS / turns))


def _shape(draw: Draw) -> float:
    return draw.one_of(1.0, 2.0) if draw.other else 0.0


def _periodic(
    draw: Draw, group: str, changes: dict[str, float], order: float, amplitude: float, phase: float, second: float = 0.0
) -> Concealed:
    """A wave over position; the first harmonic of another wave than a sine is all that a model could say of it."""
    first = amplitude * (8.0 / math.pi**2 if changes[_SHAPES[group]] == 1.0 else 1.0)
    rows = _rows(order, first, phase, second)
    return Concealed(changes, _first(rows), None if draw.other else {group: {"harmonics": rows}})


_SHAPES = {
    listed.POSITION_DEPENDENT_FRICTION: "grip_shape",
    listed.COGGING: "cogging_shape",
    listed.TORQUE_RIPPLE: "ripple_shape",
}


def _rows(order: float, amplitude: float, phase: float, second: float) -> list[Document]:
    rows = [{"amplitude": amplitude, "periods_per_turn": order, "phase": phase}]
    return rows + ([{"amplitude": second, "periods_per_turn": 2.0 * order, "phase": 2.0 * phase}] if second else [])


def _first(rows: list[Document]) -> dict[str, float]:
    return dict(rows[0])


# --- Friction --------------------------------------------------------------------------------------------------------
# Draws concealed friction: by direction, near rest, over speed, load and temperature. Sizes are shares of Coulomb
# friction.


def asymmetry(draw: Draw) -> Concealed:
    """Both kinds of friction differ by direction; otherwise dry or viscous friction alone."""
    share = min(draw.size(0.05, 0.2), 0.6) * draw.sign()
    front, back = (1.0 + share, 1.0 - share) if draw.flip() else (1.0, (1.0 - share) / (1.0 + share))
    dry, viscous = (True, True) if not draw.other else (True, False)
    changes = {"front_dry": front if dry else 1.0, "back_dry": back if dry else 1.0}
    changes |= {"front_viscous": front if viscous else 1.0, "back_viscous": back if viscous else 1.0}
    names = {"positive_dry": "front_dry", "negative_dry": "back_dry"}
    names |= {"positive_viscous": "front_viscous", "negative_viscous": "back_viscous"}
    group = {key: changes[own] for key, own in names.items()}
    return Concealed(changes, {"negative_over_positive": back / front}, {listed.ASYMMETRY: group})


def stribeck(draw: Draw) -> Concealed:
    """Friction falls as the axis sets off, where the model's is flat; otherwise by another exponent."""
    p = draw.physics
    excess = min(draw.size(0.4, 0.9), 2.5)
    exponent = draw.one_of(1.0, 0.7, 3.0) if draw.other else 2.0
    static, velocity = p.coulomb * (1.0 + excess), p.stribeck_velocity * draw.between(0.7, 1.4)
    changes = {"static": static, "stribeck_velocity": velocity, "stribeck_exponent": exponent}
    group = {"static": static, "stribeck_velocity": velocity, "exponent": exponent}
    parameters = {"static": static, "stribeck_velocity": velocity} | ({"exponent": exponent} if draw.other else {})
    return Concealed(changes, parameters, {listed.STRIBECK: group}, {"static": p.coulomb})


def presliding(draw: Draw) -> Concealed:
    """The bristle is softer or stiffer than believed; otherwise it also holds without creeping (elasto-plastic)."""
    p = draw.physics
    factor = 2.0 + min(draw.size(0.8, 3.0), 8.0)
    stiffer = draw.between(0.0, 1.0) < 0.4
    sigma0 = p.sigma0 * (factor if stiffer else 1.0 / factor)
    sigma1 = p.sigma1 * (1.0 if draw.flip() else factor**0.5 if stiffer else factor**-0.5)
    changes = {"sigma0": sigma0, "sigma1": sigma1, "elastic_share": 0.6 if draw.other else 0.0}
    found = {"sigma0": sigma0, "sigma1": sigma1}
    believed = {"sigma0": p.sigma0, "sigma1": p.sigma1}
    return Concealed(changes, found, None if draw.other else {listed.PRESLIDING: found}, believed)


def viscous_nonlinear(draw: Draw) -> Concealed:
    """A quadratic drag; otherwise a cubic one or one that thins out."""
    p, speed = draw.physics, draw.axis.speed
    torque = draw.size(0.2, 0.8) * (p.coulomb + 0.4 * p.viscous * speed)
    exponent = draw.one_of(3.0, 0.5, 2.5) if draw.other else 2.0
    changes = {"drag_torque": torque, "drag_speed": speed, "drag_exponent": exponent}
    coefficient = torque / speed**exponent
    key = {2.0: "quadratic", 3.0: "cubic"}.get(exponent, "power")
    group = {key: coefficient} | ({"exponent": exponent} if key == "power" else {})
    return Concealed(changes, group, {listed.VISCOUS_NONLINEAR: group})


def load_dependent_friction(draw: Draw) -> Concealed:
    """Friction per torque of the drive; otherwise per torque of the load, when there is a weight."""
    share = min(draw.size(0.05, 0.2), 0.6)
    if draw.other and draw.physics.gravity > 0.0:
        share = min(2.0 * share, 0.8)
        return Concealed(
            {"dry_per_load": share}, {"per_load": share}, {listed.LOAD_DEPENDENT_FRICTION: {"per_load": share}}
        )
    found = {"per_command": share}
    return Concealed({"dry_per_torque": share}, found, {listed.LOAD_DEPENDENT_FRICTION: found})


def thermal(draw: Draw) -> Concealed:
    """Friction falls exponentially as the joint warms; otherwise in a straight line, or nobody recorded how warm."""
    viscous, dry = min(draw.size(0.02, 0.05), 0.12), min(draw.size(0.012, 0.03), 0.08)
    straight, blind = draw.other and draw.flip(), draw.between(0.0, 1.0) < NO_THERMOMETER
    changes = {"warm_dry": dry, "warm_viscous": viscous, "warm_shape": 0.0 if straight else 1.0}
    shape = "linear" if straight else "exponential"
    found = {"dry_per_c": -dry, "viscous_per_c": -viscous}
    if blind:
        return Concealed(changes, {}, None, thermometer=False, cold=draw.flip())
    return Concealed(changes, found, {listed.THERMAL: {**found, "shape": shape}}, thermometer=True)


# --- On nobody's list ------------------------------------------------------------------------------------------------
# Draws physics that is on nobody's list: the right answer is that something unexplained is there, and where.


def cage_resonance(draw: Draw) -> Concealed:
    """Friction that peaks in a band of speeds."""
    speed = draw.between(0.25, 0.5) * draw.axis.speed
    torque = draw.size(0.5, 1.0) * draw.physics.coulomb * 1.2
    return Concealed({"peak_torque": torque, "peak_speed": speed, "peak_width": 0.18 * speed})


def ageing_contacts(draw: Draw) -> Concealed:
    """Friction that grows with the time at rest and is forgotten in motion, which takes time too."""
    return Concealed({"ageing": draw.size(0.6, 1.2), "ageing_s": draw.between(0.15, 0.4)})


def relaxing_spring(draw: Draw) -> Concealed:
    """A belt that creeps: a spring whose rest position follows within a second."""
    stiffness = draw.size(0.8, 1.6) * draw.physics.coulomb / draw.axis.motions.travel
    return Concealed({"relaxing": stiffness, "relaxing_s": draw.between(0.3, 1.0)})


def chaotic_load(draw: Draw) -> Concealed:
    """A load that swings by itself and never repeats."""
    return Concealed({"chaos": draw.size(0.3, 0.7) * draw.physics.coulomb, "chaos_rate": draw.between(0.6, 1.5)})


def travelled_way(draw: Draw) -> Concealed:
    """Friction with a period in the way travelled: balls that recirculate."""
    return Concealed({"way_share": min(draw.size(0.3, 0.5), 0.9), "way_length": draw.between(0.45, 0.9)})


def patchy_friction(draw: Draw) -> Concealed:
    """Friction that jumps between two levels at times of its own."""
    return Concealed({"patchy_share": draw.size(0.25, 0.5), "patchy_s": draw.between(0.3, 0.8)})


#: Draws what is concealed on an axis.
Hide = Callable[[Draw], Concealed]

HIDE: Mapping[str, Hide] = {
    listed.ASYMMETRY: asymmetry,
    listed.STRIBECK: stribeck,
    listed.PRESLIDING: presliding,
    listed.VISCOUS_NONLINEAR: viscous_nonlinear,
    listed.LOAD_DEPENDENT_FRICTION: load_dependent_friction,
    listed.POSITION_DEPENDENT_FRICTION: position_dependent_friction,
    listed.COGGING: cogging,
    listed.TORQUE_RIPPLE: torque_ripple,
    listed.GRAVITY: gravity,
    listed.SPRING: spring,
    listed.BACKLASH: backlash,
    listed.JOINT_ELASTICITY: joint_elasticity,
    listed.TORQUE_GAIN: torque_gain,
    listed.TORQUE_SATURATION: torque_saturation,
    listed.DELAY: delay,
    listed.ACTUATOR_LAG: actuator_lag,
    listed.THERMAL: thermal,
    listed.INERTIA: inertia,
    listed.POSITION_DEPENDENT_INERTIA: position_dependent_inertia,
    listed.ENCODER_ECCENTRICITY: encoder_eccentricity,
    listed.TORQUE_OFFSET: torque_offset,
    listed.DISTURBANCE: disturbance,
}

UNLISTED: Mapping[str, Hide] = {
    "cage_resonance": cage_resonance,
    "ageing_contacts": ageing_contacts,
    "relaxing_spring": relaxing_spring,
    "chaotic_load": chaotic_load,
    "travelled_way": travelled_way,
    "patchy_friction": patchy_friction,
}
