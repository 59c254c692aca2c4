"""Units of foreign columns, and by how much each is a unit of the SI: what `unit:` in a `--map` file may say.

Under `columns`. Foot, inch and pound are the international ones of 1959 (BIPM, NIST SP 811); weight at 9.80665 m/s².
"""

from __future__ import annotations

import difflib
import math
import unicodedata
from enum import Enum
from typing import NamedTuple

_POUND_N = 0.45359237 * 9.80665
_INCH_M = 0.0254
_TURN_RAD = 2.0 * math.pi
_DEGREE_RAD = math.pi / 180.0


class Dimension(Enum):
    """What is measured."""

    TIME = "time"
    ANGLE = "angle"
    LENGTH = "length"
    ANGULAR_VELOCITY = "angular velocity"
    VELOCITY = "velocity"
    TORQUE = "torque"
    FORCE = "force"
    CURRENT = "current"
    VOLTAGE = "voltage"
    TEMPERATURE = "temperature"
    RATIO = "ratio"
    NUMBER = "number"


class Unit(NamedTuple):
    """A unit: so many of the SI's are one, and so much is its zero; `counted` where a turn must be told as well."""

    dimension: Dimension
    scale: float
    zero: float = 0.0
    counted: bool = False


#: Units by dimension, each with the name that is told; the first is the canonical one.
_TABLE: dict[Dimension, dict[str, float]] = {
    Dimension.TIME: {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0},
    Dimension.ANGLE: {
        **{"rad": 1.0, "mrad": 1e-3, "urad": 1e-6, "deg": _DEGREE_RAD, "turn": _TURN_RAD},
        **{"arcmin": _DEGREE_RAD / 60.0, "arcsec": _DEGREE_RAD / 3600.0, "gon": math.pi / 200.0},
    },
    Dimension.LENGTH: {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "nm": 1e-9, "inch": _INCH_M, "ft": 12 * _INCH_M},
    Dimension.ANGULAR_VELOCITY: {
        **{"rad/s": 1.0, "mrad/s": 1e-3, "deg/s": _DEGREE_RAD, "rpm": _TURN_RAD / 60.0, "turn/s": _TURN_RAD}
    },
    Dimension.VELOCITY: {
        **{"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3, "um/s": 1e-6, "m/min": 1.0 / 60.0, "mm/min": 1e-3 / 60.0},
        **{"inch/s": _INCH_M, "inch/min": _INCH_M / 60.0, "ft/s": 12 * _INCH_M},
    },
    Dimension.TORQUE: {
        **{"N*m": 1.0, "mN*m": 1e-3, "kN*m": 1e3, "N*cm": 1e-2, "N*mm": 1e-3, "kgf*m": 9.80665, "kgf*cm": 0.0980665},
        **{"lb*ft": _POUND_N * 12 * _INCH_M, "lb*inch": _POUND_N * _INCH_M, "oz*inch": _POUND_N / 16 * _INCH_M},
    },
    Dimension.FORCE: {"N": 1.0, "mN": 1e-3, "kN": 1e3, "kgf": 9.80665, "lb": _POUND_N, "oz": _POUND_N / 16},
    Dimension.CURRENT: {"A": 1.0, "mA": 1e-3, "uA": 1e-6},
    Dimension.VOLTAGE: {"V": 1.0, "mV": 1e-3, "kV": 1e3},
    Dimension.TEMPERATURE: {"degC": 1.0, "K": 1.0, "degF": 5.0 / 9.0},
    Dimension.RATIO: {"1": 1.0, "percent": 1e-2, "permille": 1e-3},
    Dimension.NUMBER: {"1": 1.0},
}
_ZEROS = {"K": -273.15, "degF": -32.0 * 5.0 / 9.0}
#: Units in which a turn must be told as well (`counts_per_turn`), as if a turn were one count.
_COUNTED = {Dimension.ANGLE: "counts", Dimension.ANGULAR_VELOCITY: "counts/s"}
#: Other ways to write a unit, in small letters where no other unit differs by them.
_ALIASES = {
    **{"sec": "s", "seconds": "s", "second": "s", "msec": "ms", "usec": "us", "hour": "h", "minute": "min"},
    **{"°": "deg", "degree": "deg", "degrees": "deg", "rev": "turn", "turns": "turn", "revolutions": "turn"},
    **{"radian": "rad", "radians": "rad", "count": "counts", "ticks": "counts", "steps": "counts", "'": "arcmin"},
    **{"in": "inch", '"': "inch", "inches": "inch", "foot": "ft", "feet": "ft", "micron": "um"},
    **{"1/min": "rpm", "r/min": "rpm", "rev/min": "rpm", "turn/min": "rpm", "rev/s": "turn/s", "rps": "turn/s"},
    **{"°/s": "deg/s", "dps": "deg/s", "in/s": "inch/s", "ips": "inch/s", "ipm": "inch/min", "in/min": "inch/min"},
    **{"Nm": "N*m", "mNm": "mN*m", "kNm": "kN*m", "Ncm": "N*cm", "Nmm": "N*mm", "kgfcm": "kgf*cm", "kgcm": "kgf*cm"},
    **{"kg*cm": "kgf*cm", "kg*m": "kgf*m", "lbf": "lb", "lbs": "lb", "pound": "lb", "pounds": "lb", "ozf": "oz"},
    **{"lbf*ft": "lb*ft", "ft*lb": "lb*ft", "ft*lbf": "lb*ft", "ftlb": "lb*ft", "lbft": "lb*ft"},
    **{"lbf*in": "lb*inch", "in*lb": "lb*inch", "in*lbf": "lb*inch", "lb*in": "lb*inch", "inlb": "lb*inch"},
    **{"ozf*in": "oz*inch", "oz*in": "oz*inch", "in*oz": "oz*inch", "ozin": "oz*inch"},
    **{"ampere": "A", "amps": "A", "amp": "A", "Amps": "A", "volt": "V", "volts": "V", "Volts": "V"},
    **{"°C": "degC", "C": "degC", "celsius": "degC", "Celsius": "degC", "°F": "degF", "F": "degF", "kelvin": "K"},
    **{"%": "percent", "‰": "permille", "none": "1", "ratio": "1", "cps": "counts/s", "ticks/s": "counts/s"},
    **{"newton": "N", "newtons": "N"},
}
#: Dimensions that become another one by a factor that the map must give: a torque constant, a gear, a spindle.
_BY_A_FACTOR: dict[Dimension, tuple[Dimension, ...]] = {
    Dimension.TORQUE: (Dimension.CURRENT, Dimension.VOLTAGE, Dimension.RATIO, Dimension.FORCE),
    Dimension.FORCE: (Dimension.CURRENT, Dimension.VOLTAGE, Dimension.RATIO, Dimension.TORQUE),
    Dimension.ANGLE: (Dimension.LENGTH, Dimension.VOLTAGE, Dimension.RATIO),
    Dimension.LENGTH: (Dimension.ANGLE, Dimension.VOLTAGE, Dimension.RATIO),
    Dimension.ANGULAR_VELOCITY: (Dimension.VELOCITY, Dimension.VOLTAGE),
    Dimension.VELOCITY: (Dimension.ANGULAR_VELOCITY, Dimension.VOLTAGE),
    Dimension.CURRENT: (Dimension.VOLTAGE, Dimension.RATIO),
    Dimension.VOLTAGE: (Dimension.RATIO,),
    Dimension.RATIO: (Dimension.VOLTAGE,),
    Dimension.TEMPERATURE: (Dimension.VOLTAGE,),
}
#: Endings of canonical names, the longest first.
_ENDINGS = {
    **{
        "_rad_s": Dimension.ANGULAR_VELOCITY,
        "_m_s": Dimension.VELOCITY,
        "_rad": Dimension.ANGLE,
        "_m": Dimension.LENGTH,
    },
    **{"_nm": Dimension.TORQUE, "_n": Dimension.FORCE, "_a": Dimension.CURRENT, "_v": Dimension.VOLTAGE},
    **{"_c": Dimension.TEMPERATURE, "t_s": Dimension.TIME, "duty": Dimension.RATIO},
}


def dimension_of(canonical: str) -> Dimension:
    """What a canonical column measures, by the unit in its name."""
    return next((kind for ending, kind in _ENDINGS.items() if canonical.endswith(ending)), Dimension.NUMBER)


def units_of(dimension: Dimension) -> tuple[str, ...]:
    """Names of the units of a dimension."""
    counted = (_COUNTED[dimension],) if dimension in _COUNTED else ()
    return (*_TABLE[dimension], *counted)


def spellings() -> dict[str, tuple[str, ...]]:
    """Other ways to write each unit that has any, by the name that is told.

    >>> spellings()["s"], spellings()["turn"]
    (('sec', 'seconds', 'second'), ('rev', 'turns', 'revolutions'))
    """
    named = dict.fromkeys(unit for dimension in Dimension for unit in units_of(dimension))
    return {unit: found for unit in named if (found := tuple(name for name, of in _ALIASES.items() if of == unit))}


def find_unit(name: str, canonical: str, scaled: bool) -> Unit | str:
    """The unit of this name for this column; `scaled` tells that the map gives a factor of its own.

    A text that says what is allowed where it is none.

    >>> find_unit("mA", "current_a", False).scale, find_unit("Nm", "torque_nm", False).scale
    (0.001, 1.0)
    >>> find_unit("mA", "torque_nm", False)
    'N*m, mN*m, kN*m, N*cm, N*mm, kgf*m, kgf*cm, lb*ft, lb*inch, oz*inch, or mA with scale: N*m for each A'
    """
    wanted = dimension_of(canonical)
    plain = _plain(name)
    for dimension in (wanted, *_BY_A_FACTOR.get(wanted, ())):
        if plain in units_of(dimension) and (dimension is wanted or scaled):
            if plain == _COUNTED.get(dimension):
                return Unit(dimension, _TURN_RAD, counted=True)
            return Unit(dimension, _TABLE[dimension][plain], _ZEROS.get(plain, 0.0))
    allowed = ", ".join(units_of(wanted))
    other = next((kind for kind in _BY_A_FACTOR.get(wanted, ()) if plain in units_of(kind)), None)
    if other is not None:
        return f"{allowed}, or {name} with scale: {units_of(wanted)[0]} for each {units_of(other)[0]}"
    close = difflib.get_close_matches(plain, units_of(wanted), n=1)
    return f"{allowed} (did you mean {close[0]}?)" if close else allowed


def _plain(name: str) -> str:
    """A unit's name without blanks and signs that differ by the keyboard alone."""
    told = unicodedata.normalize("NFKC", name.strip()).replace("μ", "u").replace("µ", "u")
    for sign in ("·", "⋅", "∙", "•", "×"):
        told = told.replace(sign, "*")
    told = "".join(told.split())
    return _ALIASES.get(told) or _ALIASES.get(told.lower()) or told
