"""Names of recorded columns: one name with its unit for each quantity, rotary and linear; and `--map` files.

Stands between the foreign file (`readers`) and the recording (`recording`).
"""

from __future__ import annotations

import difflib
import re
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
from servod.lab.recordings.units import Unit, find_unit


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

    @property
    def told(self) -> str:
        """The source in words."""
        return self.source if self.source is not None else f"{self.from_name}... in the file's name"

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
    places: dict[str, Element] = {}
    for canonical, source in list(chosen.items()):
        if source.source is None:
            continue
        place = find_source(source.source, present)
        if place is None and source.optional:
            del chosen[canonical]
            continue
        if place is None:
            found = f"none, but {canonical} is mapped"
            raise BadInput(f"{where}: column {source.source}", found, _near(source.source, present))
        places[canonical] = place
    used = {place.name for place in places.values()}
    return chosen, places, [name for name in present if name not in used]


def axis_of(names: Iterable[str], foreign: Iterable[str], where: str) -> AxisKind:
    """Whether these canonical columns belong to a rotary or a linear axis; `foreign` are all that the file has.

    Raises BadInput when neither set is complete.
    """
    present = set(names)
    for axis in AxisKind:
        other = {q.column(one) for q in (Quantity.TORQUE, Quantity.POSITION) for one in AxisKind if one is not axis}
        needed = all(quantity.column(axis) in present for quantity in REQUIRED)
        told = {quantity.column(axis) for quantity in COMMANDS if quantity.column(axis) in present}
        if needed and told and (Quantity.TORQUE.column(axis) in told or not present & other):
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
