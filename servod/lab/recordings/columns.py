"""Names of recorded columns: one name with its unit for each quantity, rotary and linear; and `--map` files.

Stands between the foreign file (`readers`) and the recording (`recording`).
"""

from __future__ import annotations

import difflib
import math
import re
import unicodedata
from collections.abc import Iterable, Mapping
from enum import Enum
from pathlib import Path
from typing import Annotated, NamedTuple

from pydantic import BeforeValidator, Field, model_validator

from servod.common.errors import BadInput
from servod.common.files import BadFile
from servod.common.yaml import Strict
from servod.formats.kinds import FileKind, load_kind
from servod.formats.model.axis_model import AxisKind
from servod.lab.recordings.bounds import by_number


class Quantity(Enum):
    """What a column holds: (name on a rotary axis, name on a linear axis)."""

    TIME = ("t_s", "t_s")
    TORQUE = ("torque_nm", "force_n")
    POSITION = ("position_rad", "position_m")
    REFERENCE = ("reference_rad", "reference_m")
    VELOCITY = ("velocity_rad_s", "velocity_m_s")
    TORQUE_ACTUAL = ("torque_actual_nm", "force_actual_n")
    CURRENT = ("current_a", "current_a")
    TEMPERATURE = ("temperature_c", "temperature_c")
    LOAD_POSITION = ("load_position_rad", "load_position_m")
    LOAD_TORQUE = ("load_torque_nm", "load_force_n")
    CYCLE = ("cycle", "cycle")
    DUTY = ("duty", "duty")
    VOLTAGE = ("voltage_v", "voltage_v")
    SUPPLY = ("supply_v", "supply_v")
    GAIN = ("kp", "kp")
    ENABLED = ("enabled", "enabled")
    SPEED_REFERENCE = ("velocity_reference_rad_s", "velocity_reference_m_s")

    def column(self, axis: AxisKind) -> str:
        """Name of this quantity's column on such an axis."""
        return self.value[1] if axis is AxisKind.LINEAR else self.value[0]


#: Without these nothing is a recording of an axis.
REQUIRED = (Quantity.TIME, Quantity.POSITION)
#: One of these besides: what the axis was told to do. A torque can be replayed as it is; the others go through a drive.
COMMANDS = (
    *(Quantity.TORQUE, Quantity.REFERENCE, Quantity.VOLTAGE, Quantity.DUTY, Quantity.CURRENT),
    Quantity.SPEED_REFERENCE,
)

ALL_NAMES: tuple[str, ...] = tuple(dict.fromkeys(name for quantity in Quantity for name in quantity.value))


#: Folder of the maps that come with servod: layouts in which people publish recordings.
SHIPPED = Path(__file__).with_name("maps")
_ELEMENT = re.compile(r"(.*)\[(?::, ?(\d{1,4})|(\d{1,4}), ?:|(\d{1,4}))\]", re.DOTALL)
#: How the one matrix of a file without names is called.
_NAMELESS = ("", "data")


class Element(NamedTuple):
    """Where a column stands in a file: the name there, and the number of the column (or row) of a matrix."""

    name: str
    at: int | None = None
    row: bool = False


class ColumnSource(Strict):
    """Where a canonical column comes from: canonical = scale*foreign + offset, with the foreign value in SI units."""

    source: str | None = Field(
        None, alias="from", min_length=1, description="name of the foreign column, or its number, counted from 0"
    )
    from_name: str | None = Field(
        None, min_length=1, max_length=64, description="the number behind this text in the file's name, for all rows"
    )
    unit: str | None = Field(None, max_length=32, description="unit of the foreign column; none: that of the canonical")
    counts_per_turn: float | None = Field(None, gt=0.0, le=1e12, description="with unit counts or counts/s")
    scale: float = 1.0
    offset: float = Field(0.0, description="in the canonical unit")
    optional: bool = Field(False, description="a file without this foreign column is read without it")

    @model_validator(mode="after")
    def _one_source(self) -> ColumnSource:
        if (self.source is None) == (self.from_name is None):
            raise ValueError("one of from and from_name")
        return self

    def require_unit(self, canonical: str, where: str) -> None:
        """See that the unit is one of this canonical column's. Raises BadInput; `where` is the map's file."""
        key = f"{where}: columns.{canonical}"
        unit = self._unit(canonical)
        if isinstance(unit, str):
            raise BadInput(f"{key}.unit", self.unit, unit)
        if unit is not None and unit.counted and self.counts_per_turn is None:
            raise BadInput(f"{key}.counts_per_turn", "none", "counts of one turn, as unit counts needs them")
        if self.counts_per_turn is not None and not (unit is not None and unit.counted):
            raise BadInput(f"{key}.counts_per_turn", self.counts_per_turn, "only with unit counts or counts/s")

    def _unit(self, canonical: str) -> Unit | str | None:
        if self.unit is None:
            return None
        return find_unit(self.unit, canonical, scaled="scale" in self.model_fields_set)

    def line(self, canonical: str) -> tuple[float, float]:
        """Factor and offset from the foreign column to the canonical one, unit included."""
        unit = self._unit(canonical)
        if not isinstance(unit, Unit):
            return self.scale, self.offset
        to_si = unit.scale / self.counts_per_turn if unit.counted and self.counts_per_turn else unit.scale
        return self.scale * to_si, self.scale * unit.zero + self.offset


def _long_form(source: object) -> object:
    """A bare name or number stands for that column as it is; so mistakes in any form are told of the long one."""
    if isinstance(source, str | int) and not isinstance(source, bool):
        source = {"from": source}
    if isinstance(source, dict):
        source = dict(source)
        at = source.get("from")
        if isinstance(at, int) and not isinstance(at, bool) and 0 <= at < 10_000:
            source["from"] = by_number(at)
        if isinstance(source.get("unit"), int | float) and source["unit"] == 1:
            source["unit"] = "1"
    return source


class ColumnMap(Strict):
    """A `--map` file: `columns: {t_s: {from: time, unit: ms}, force_n: {from: vir, scale: 35.1507}}`."""

    columns: dict[str, Annotated[ColumnSource, BeforeValidator(_long_form)]] = Field(min_length=1)

    def sources(self, where: str) -> dict[str, ColumnSource]:
        """Canonical name -> source. Raises BadInput for a name or a unit that is none; `where` is the map's file."""
        for name, source in self.columns.items():
            if name not in ALL_NAMES:
                raise BadInput(f"{where}: columns.{name}", "no canonical column", _near(name, ALL_NAMES))
            source.require_unit(name, where)
        return self.columns


def shipped_maps() -> tuple[str, ...]:
    """Names of the maps that come with servod."""
    return tuple(sorted(path.stem for path in SHIPPED.glob("*.yaml")))


def find_map(path: Path) -> Path:
    """The `--map` file at `path`, or the shipped one of this name; a file of one's own goes first."""
    return SHIPPED / f"{path}.yaml" if str(path) in shipped_maps() and not path.exists() else path


def load_column_map(path: Path) -> dict[str, ColumnSource]:
    """Canonical name -> source of the `--map` file at `path`, or of the shipped map of this name. Raises BadInput."""
    path = find_map(path)
    if not path.exists():
        needed = f"a map file, or one of {', '.join(shipped_maps())}"
        raise BadFile(str(path), "there is no such file", needed, more=needed)
    return load_kind(path, FileKind.MAP, ColumnMap).sources(str(path))


def wanted_names(sources: Iterable[ColumnSource]) -> set[str]:
    """Names under which the columns of these sources may stand in a file: what a reader must keep."""
    found = set(ALL_NAMES)
    for source in sources:
        if source.source is not None:
            name, at, _ = element_of(source.source)
            found |= {source.source, name} | ({by_number(at)} if at is not None and name in _NAMELESS else set())
            found |= {f"{name}{by_number(at)}"} if at is not None else set()
    return found


def element_of(source: str) -> Element:
    """The matrix and the column that a source names: `data[:,3]`, `data[3,:]` for a row, `state[3]` of lists."""
    parts = _ELEMENT.fullmatch(source)
    if parts is None:
        return Element(source)
    name, column, row, cell = parts.groups()
    return Element(name, int(column or row or cell), row is not None)


def find_source(source: str, names: list[str]) -> Element | None:
    """Where a source stands in a file of these names; None where it does not."""
    if source in names:
        return Element(source)
    name, at, row = element_of(source)
    if at is None:
        return None
    if name in names:
        return Element(name, at, row)
    if f"{name}{by_number(at)}" in names:
        return Element(f"{name}{by_number(at)}")
    if name in _NAMELESS and names == ["data"]:
        return Element("data", at, row)
    return Element(names[at]) if name in _NAMELESS and at < len(names) and not row else None


def apply_map(
    names: Iterable[str], sources: Mapping[str, ColumnSource], where: str
) -> tuple[dict[str, ColumnSource], dict[str, Element], list[str]]:
    """Source of every canonical column that the file has, directly or by the map; where each stands in the file; and
    the names left unused.

    Raises BadInput when the map names a column that the file does not have.
    """
    present = list(names)
    chosen = {name: ColumnSource.model_validate({"from": name}) for name in present if name in ALL_NAMES}
    chosen.update(sources)
    elements: dict[str, Element] = {}
    for canonical, source in list(chosen.items()):
        if source.source is None:
            continue
        found_element = find_source(source.source, present)
        if found_element is None and source.optional:
            del chosen[canonical]
            continue
        if found_element is None:
            found = f"none, but {canonical} is mapped"
            raise BadInput(f"{where}: column {source.source}", found, _near(source.source, present))
        elements[canonical] = found_element
    used = {found_element.name for found_element in elements.values()}
    return chosen, elements, [name for name in present if name not in used]


def axis_of(names: Iterable[str], foreign: Iterable[str], where: str) -> AxisKind:
    """Whether these canonical columns belong to a rotary or a linear axis; `foreign` are all that the file has.

    Raises BadInput when neither set is complete.
    """
    present = set(names)
    for axis in AxisKind:
        other = {q.column(one) for q in (Quantity.TORQUE, Quantity.POSITION) for one in AxisKind if one is not axis}
        needed = all(quantity.column(axis) in present for quantity in REQUIRED)
        commands = {quantity.column(axis) for quantity in COMMANDS if quantity.column(axis) in present}
        if needed and commands and (Quantity.TORQUE.column(axis) in commands or not present & other):
            return axis
    linear = any(quantity.value[1] in present for quantity in (Quantity.TORQUE, Quantity.POSITION))
    axis = AxisKind.LINEAR if linear else AxisKind.ROTARY
    missing = [
        q.column(axis) for q in (Quantity.TIME, Quantity.TORQUE, Quantity.POSITION) if q.column(axis) not in present
    ]
    every = list(foreign)
    listed = ", ".join(every)[:200]
    if every and every == [by_number(at) for at in range(len(every))]:
        allowed = "a header line with the columns' names, or a --map file that counts them (t_s: {from: 0})"
        raise BadInput(f"{where}: line 1", f"no names of columns, {len(every)} numbers", allowed)
    wanted = "t_s, torque_nm, position_rad (rotary) or t_s, force_n, position_m (linear), or a --map file"
    if missing == [Quantity.TORQUE.column(axis)]:
        others = ", ".join(quantity.column(axis) for quantity in COMMANDS[1:])
        wanted = f"{wanted}; without a torque one of {others}"
    raise BadInput(f"{where}: column {missing[0]}", f"none (columns: {listed})", wanted)


def _near(name: str, allowed: Iterable[str]) -> str:
    known = list(allowed)
    close = difflib.get_close_matches(name, known, n=1)
    hint = f" (did you mean {close[0]}?)" if close else ""
    return ", ".join(known[:40]) + hint


# --- Units -----------------------------------------------------------------------------------------------------------
# Units of foreign columns, and by how much each is a unit of the SI: what `unit:` in a `--map` file may say.
#
# Foot, inch and pound are the international ones of 1959 (BIPM, NIST SP 811); weight at 9.80665 m/s².


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
    plain = unicodedata.normalize("NFKC", name.strip()).replace("μ", "u").replace("µ", "u")
    for sign in ("·", "⋅", "∙", "•", "×"):
        plain = plain.replace(sign, "*")
    plain = "".join(plain.split())
    return _ALIASES.get(plain) or _ALIASES.get(plain.lower()) or plain
