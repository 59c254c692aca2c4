"""Names of recorded columns: one name with its unit for each quantity, rotary and linear; and `--map` files.

Stands between the foreign file (`readers`) and the recording (`recording`).
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from enum import Enum
from pathlib import Path
from typing import Annotated

from pydantic import BeforeValidator, Field

from servod.common.errors import BadInput
from servod.common.yaml import Strict
from servod.formats.kinds import FileKind, load_kind
from servod.formats.model.axis_model import AxisKind


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

    def column(self, axis: AxisKind) -> str:
        """Name of this quantity's column on such an axis."""
        return self.value[1] if axis is AxisKind.LINEAR else self.value[0]


#: Without these there is nothing to replay.
REQUIRED = (Quantity.TIME, Quantity.TORQUE, Quantity.POSITION)

ALL_NAMES: tuple[str, ...] = tuple(dict.fromkeys(name for quantity in Quantity for name in quantity.value))


class ColumnSource(Strict):
    """Where a canonical column comes from: canonical = scale*foreign + offset."""

    source: str = Field(alias="from", min_length=1, description="name of the foreign column")
    scale: float = 1.0
    offset: float = Field(0.0, description="in the canonical unit")


def _long_form(source: object) -> object:
    """A bare name stands for that column as it is; so mistakes in either form are told of the long one."""
    return {"from": source} if isinstance(source, str) else source


class ColumnMap(Strict):
    """A `--map` file: `columns: {t_s: t, force_n: {from: vir, scale: 35.1507}}`."""

    columns: dict[str, Annotated[ColumnSource, BeforeValidator(_long_form)]] = Field(min_length=1)

    def sources(self, where: str) -> dict[str, ColumnSource]:
        """Canonical name -> source. Raises BadInput for a name that is not canonical; `where` is the map's file."""
        for name in self.columns:
            if name not in ALL_NAMES:
                raise BadInput(f"{where}: columns.{name}", "no canonical column", _near(name, ALL_NAMES))
        return self.columns


def load_column_map(path: Path) -> dict[str, ColumnSource]:
    """Canonical name -> source of the `--map` file at `path`. Raises BadInput."""
    return load_kind(path, FileKind.MAP, ColumnMap).sources(str(path))


def apply_map(
    names: Iterable[str], sources: Mapping[str, ColumnSource], where: str
) -> tuple[dict[str, ColumnSource], list[str]]:
    """Source of every canonical column that the file has, directly or by the map, and the names left unused.

    Raises BadInput when the map names a column that the file does not have.
    """
    present = list(names)
    for canonical, source in sources.items():
        if source.source not in present:
            raise BadInput(
                f"{where}: column {source.source}", f"none, but {canonical} is mapped", _near(source.source, present)
            )
    chosen = {name: ColumnSource.model_validate({"from": name}) for name in present if name in ALL_NAMES}
    chosen.update(sources)
    used = {source.source for source in chosen.values()}
    return chosen, [name for name in present if name not in used]


def axis_of(names: Iterable[str], foreign: Iterable[str], where: str) -> AxisKind:
    """Whether these canonical columns belong to a rotary or a linear axis; `foreign` are all that the file has.

    Raises BadInput when neither set is complete.
    """
    present = set(names)
    for axis in AxisKind:
        if all(quantity.column(axis) in present for quantity in REQUIRED):
            return axis
    linear = sum(quantity.value[1] in present for quantity in REQUIRED[1:])
    axis = AxisKind.LINEAR if linear else AxisKind.ROTARY
    missing = [q.column(axis) for q in REQUIRED if q.column(axis) not in present]
    wanted = "t_s, torque_nm, position_rad (rotary) or t_s, force_n, position_m (linear), or a --map file"
    raise BadInput(f"{where}: column {missing[0]}", f"none (columns: {', '.join(foreign)[:200]})", wanted)


def _near(name: str, allowed: Iterable[str]) -> str:
    known = list(allowed)
    close = difflib.get_close_matches(name, known, n=1)
    hint = f" (did you mean {close[0]}?)" if close else ""
    return ", ".join(known[:40]) + hint
