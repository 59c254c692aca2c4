"""Actions on gain-set files: what befalls them between the moment they are stored and the moment they are to run."""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import yaml

from servod.common.shipped import shipped
from servod.formats.protocol import Verb
from servod.qualify.faults.actions.processes import ProcessAction

if TYPE_CHECKING:
    from servod.qualify.faults.actions.base import Action
    from servod.qualify.faults.processes import ProcessAxis

_LOADED, _OTHER = shipped("gains/demo_local.yaml"), shipped("gains/demo_pd_dob.yaml")


class Damage(StrEnum):
    """What becomes of a file."""

    CUT = "cut"  # only its first half is there
    SWAPPED = "swapped"  # another set stands under its name
    GONE = "gone"


def _cut(path: Path) -> None:
    text = path.read_text()
    path.write_text(text[: len(text) // 2])


def _swapped(path: Path) -> None:
    aside = path.with_suffix(".aside")
    aside.write_bytes(_OTHER.read_bytes())
    aside.replace(path)


_DAMAGE: dict[Damage, Callable[[Path], None]] = {
    Damage.CUT: _cut,
    Damage.SWAPPED: _swapped,
    Damage.GONE: Path.unlink,
}


def _damaged(path: Path, damage: Damage) -> bool:
    """Damage the file; True when it is gone or another one afterwards."""
    before = path.read_bytes()
    _DAMAGE[damage](path)
    return not path.exists() or path.read_bytes() != before


class StoredGains(ProcessAction):
    """A set is loaded, its file in the store is damaged, and then it shall run."""

    damage: Damage

    traceless: ClassVar[str] = "the file is as it was"

    def act(self, axis: ProcessAxis) -> int:
        """Load, damage, activate."""
        stored = axis.call(Verb.GAINS_LOAD, name=_LOADED.name, text=_LOADED.read_text())
        name, version = stored["name"], stored["version"]
        damaged = _damaged(axis.config.gains.directory / "sets" / name / f"{version:04d}.yaml", self.damage)
        axis.call(Verb.GAINS_ACTIVATE, name=name, version=version)
        return damaged


class ConfiguredGains(ProcessAction):
    """The gain set with which the daemon shall start is damaged."""

    damage: Damage

    traceless: ClassVar[str] = "the file is as it was"

    def act(self, axis: ProcessAxis) -> int:
        """Damage a copy, and name it in the configuration."""
        copy = axis.folder / "initial.yaml"
        copy.write_bytes(_LOADED.read_bytes())
        damaged = _damaged(copy, self.damage)
        data = yaml.safe_load(axis.machine.config.read_text())
        data["gains"]["initial"] = str(copy)
        axis.machine.config.write_text(yaml.safe_dump(data))
        return damaged


GAIN_FILE_ACTIONS: dict[str, type[Action]] = {"stored_gains": StoredGains, "configured_gains": ConfiguredGains}
