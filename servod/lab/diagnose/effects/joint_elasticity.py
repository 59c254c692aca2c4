"""Joint elasticity: motor and load with a spring between them."""

from __future__ import annotations

from servod.formats.model.effects import JointElasticity
from servod.lab.diagnose.effects.effect import Effect
from servod.lab.diagnose.effects.hypothesis import Term
from servod.lab.diagnose.effects.looks import Look
from servod.lab.diagnose.effects.search_context import SearchContext
from servod.lab.diagnose.effects.two_mass import two_mass_term

#: Resonances to start from, as multiples of the observer's bandwidth, and shares of the load. Factors of two are too
#: wide steps: between two of them the cost of a resonance that hardly damps has no slope towards either.
RESONANCES, SHARES = (0.3, 0.42, 0.6, 0.84, 1.2, 1.7, 2.4, 3.4, 4.8, 6.8), (0.3, 0.65)


#: Shares by which a high command would stiffen the spring if it stretched as far as a straight one, to start from.
BENDS = (0.1, 5.0)


def terms(scene: SearchContext) -> list[Term]:
    """Many starts: the cost has a valley for each resonance that the excitation holds; and springs that stiffen."""
    grid = [(fast * scene.predictor.rate, share) for fast in RESONANCES for share in SHARES]
    straight = [two_mass_term("joint_elasticity", scene, share, rate) for rate, share in grid]
    return straight + [
        two_mass_term("joint_elasticity", scene, share, rate, bend=bend) for bend in BENDS for rate, share in grid[::2]
    ]


EFFECT = Effect(
    name="joint_elasticity",
    group=JointElasticity,
    equation="J_M*a_M = u - F(v_M) - tau,  J_L*a_L = tau - load,  tau = k*d + cubic*d^3 + damping*dd/dt",
    source="Spong, ASME JDSMC 109(4), 1987; Tuttle and Seering, IEEE Trans. Robotics 12(3), 1996 (stiffening)",
    statement="The load hangs on the motor by a spring: the joint is elastic",
    shows="a mismatch that rings behind blows and accelerations, strongest around one frequency",
    confused=("inertia", "delay", "actuator_lag", "backlash", "presliding"),
    experiment="a sweep of frequencies through the resonance, or a blow with the motor held",
    terms=terms,
    look=Look("acceleration"),
    far=True,
    swift=True,
    resonant=True,
)
