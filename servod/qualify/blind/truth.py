"""What is true of a case, said in the words of an axis model file; and what its user believes.

Stands between the plant's numbers and files. Knows the file format of the outside contract, no model code.
"""

from __future__ import annotations

from collections.abc import Sequence

from servod.qualify.blind.concealed import Document
from servod.qualify.blind.physics import Physics


def believed_model(physics: Physics, off: Sequence[float]) -> Document:
    """The model that the user has: a plain joint whose parameters are `off` by a share each."""
    model = plain_model(physics)
    friction = model["friction"]
    keys = ("viscous", "coulomb", "static", "stribeck_velocity", "sigma0", "sigma1")
    friction |= {key: round(friction[key] * (1.0 + share), 12) for key, share in zip(keys, off[1:7], strict=True)}
    if physics.static == physics.coulomb:
        friction["static"] = friction["coulomb"]
    model["inertia"] *= 1.0 + off[0]
    model["gravity"]["amplitude"] *= 1.0 + off[7]
    return model


def true_model(physics: Physics, groups: Sequence[Document | None]) -> Document | None:
    """The model file that says all that is true; None where it has no words for it."""
    model = plain_model(physics)
    for group in groups:
        if group is None:
            return None
        model |= group
    return model


def plain_model(physics: Physics) -> Document:
    """The plain joint of an axis, both masses in one."""
    return {
        "inertia": physics.inertia + physics.load_inertia,
        "delay_s": 0.001,
        "friction": {
            "kind": "lugre",
            "viscous": physics.viscous + physics.load_viscous,
            "coulomb": physics.coulomb,
            "static": physics.static,
            "stribeck_velocity": physics.stribeck_velocity,
            "sigma0": physics.sigma0,
            "sigma1": physics.sigma1,
        },
        "gravity": {"amplitude": physics.gravity, "phase": physics.gravity_phase},
    }
