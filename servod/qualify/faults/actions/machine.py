"""Actions from the master's side: commands, gains and what the machine around the axis does to it."""

from __future__ import annotations

import contextlib
import math
import random
from abc import abstractmethod
from collections.abc import Callable
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import yaml
from pydantic import Field

from servod.client.axis import ReferenceMotion
from servod.common.errors import AnswerIsNo
from servod.common.shipped import shipped
from servod.drivers.virtual.port import Port
from servod.formats.protocol import Verb
from servod.kernels.laws import LAWS
from servod.qualify.faults.actions.base import InjectionAction
from servod.qualify.faults.actions.bus import CAN_ID, MASTER_GAP_MS, FrameName
from servod.qualify.faults.actions.processes import ProcessAction
from servod.qualify.faults.scenario import Loss, Runs
from servod.runtime.loop.commands import Op, ReferenceKind

if TYPE_CHECKING:
    from servod.qualify.faults.processes import ProcessAxis
    from servod.qualify.faults.stepped import SteppedUnderTest
    from servod.qualify.faults.under_test import AxisUnderTest


#: A motion that outlasts its scenario.
_LONG_S = 600.0


class OpName(StrEnum):
    """What a person can tell the axis without arguments."""

    ENABLE = "enable"
    DISABLE = "disable"
    QUICK_STOP = "quick_stop"


class SteppedAction(InjectionAction):
    """An action that only the axis in virtual time can show."""

    runs: ClassVar[frozenset[Runs]] = frozenset({Runs.STEPPED})

    def apply(self, axis: AxisUnderTest) -> None:
        """Hand over to `act`."""
        from servod.qualify.faults.stepped import SteppedUnderTest

        assert isinstance(axis, SteppedUnderTest)  # `runs` is checked when the scenario is read
        self.took(axis, self.act(axis))

    @abstractmethod
    def act(self, axis: SteppedUnderTest) -> int:
        """Let it happen to `axis` now; returns how often it took effect already."""


class GiveCommand(SteppedAction):
    """A person gives a command."""

    op: OpName
    reset_fault: bool = Field(False, description="with `enable`: reset the drive's fault first")

    def act(self, axis: SteppedUnderTest) -> int:
        """Give it; a refusal is an answer, which the judge sees."""
        axis.command(Op[self.op.name], [self.reset_fault])
        return 1


class Sine(SteppedAction):
    """A person starts a motion."""

    amplitude_rad: float
    frequency_hz: float

    def act(self, axis: SteppedUnderTest) -> int:
        """Start it, for as long as the scenario lasts."""
        return axis.command(Op.REFERENCE, [ReferenceKind.SINE, self.amplitude_rad, self.frequency_hz, _LONG_S])


class Step(InjectionAction):
    """A person lets the reference jump: all the torque that there is."""

    runs: ClassVar[frozenset[Runs]] = frozenset({Runs.STEPPED, Runs.PROCESSES, Runs.GUEST})

    amplitude_rad: float

    def apply(self, axis: AxisUnderTest) -> None:
        """Start it, for as long as the scenario lasts; one that is refused takes no effect."""
        with contextlib.suppress(AnswerIsNo):
            axis.axis.begin(ReferenceMotion.step(self.amplitude_rad, _LONG_S))
            self.took(axis, 1)


class Mortal(StrEnum):
    """A process that can die."""

    LOOP = "loop"
    SUPERVISOR = "supervisor"


class Dies(SteppedAction):
    """`kill -9` of loop, supervisor, or both at once, in virtual time."""

    who: list[Mortal] = Field(min_length=1)

    def loss(self) -> Loss:
        """The drive loses its master, or will."""
        return Loss.MASTER

    def act(self, axis: SteppedUnderTest) -> int:
        """Kill them."""
        axis.session.die(Mortal.LOOP in self.who, Mortal.SUPERVISOR in self.who)
        return 1


class WakesLate(SteppedAction):
    """The operating system wakes the loop late, up to `most_us`, in one cycle of `one_in`; SYNC comes as late."""

    traceless: ClassVar[str] = "the loop was never woken late"

    most_us: int = Field(ge=1, le=10_000_000)
    one_in: int = Field(1, ge=1)
    exactly: bool = Field(False, description="always the most, not a random share of it")
    times: int | None = Field(None, ge=1, description="so often, then punctual again")

    def loss(self) -> Loss:
        """A loop that stands still, once for long or in each second period."""
        each_second = self.exactly and self.one_in == 1 and self.times is None
        return Loss.MASTER if each_second or self.most_us > MASTER_GAP_MS * 1000 else Loss.NONE

    def wanted(self) -> int:
        """All of the times."""
        return self.times or 1

    def act(self, axis: SteppedUnderTest) -> int:
        """Disturb the pace of the loop from now on; each cycle that the session wakes late counts by itself."""
        chance = random.Random(1)  # noqa: S311  (a disturbance, no secret)
        left = self.times if self.times is not None else math.inf

        def lateness_ns() -> int:
            nonlocal left
            if left <= 0 or chance.randrange(self.one_in):
                return 0
            left -= 1
            self.took(axis, 1)
            return self.most_us * 1000 if self.exactly else chance.randrange(self.most_us * 1000)

        axis.session.lateness_ns = lateness_ns
        return 0


class Gains(SteppedAction):
    """Other gains act from now on, past the store and its certificate: the limits are on their own."""

    law: str
    parameters: list[float | str]

    def act(self, axis: SteppedUnderTest) -> int:
        """Activate them ("nan" and "inf" are written as text)."""
        numbers = [float(p) for p in self.parameters]
        return axis.command(Op.ACTIVATE, [1, LAWS[self.law].number, len(numbers), *numbers])


class Configure(SteppedAction):
    """A person mends the configuration; the next start of the daemon reads it."""

    config: dict[str, Any]

    def act(self, axis: SteppedUnderTest) -> int:
        """Lay its keys over what is there."""
        return axis.configure(self.config)


class Load(SteppedAction):
    """A weight is hung on the joint: from now on this torque acts on it from outside; 0 takes the weight away."""

    traceless: ClassVar[str] = "the load was there before"

    torque_nm: float = Field(ge=-10.0, le=10.0)

    def act(self, axis: SteppedUnderTest) -> int:
        """Hang it on."""
        joint = axis.world.devices.joint
        joint.advance(axis.now_ns())
        before, joint.load_nm = joint.load_nm, self.torque_nm
        return before != self.torque_nm


class CounterWraps(SteppedAction):
    """The encoder's counter goes over its end while the joint moves. The scenario's settings bring that about; this
    counts it, on the bus."""

    traceless: ClassVar[str] = "the counter never wrapped"

    def act(self, axis: SteppedUnderTest) -> int:
        """Listen to the encoder from now on."""
        half_range = axis.world.settings.encoder_measuring_range_counts / 2
        before: int | None = None

        def hear(can_id: int, data: bytes, _time_ns: int) -> None:
            nonlocal before
            if can_id == CAN_ID[FrameName.ENCODER_FEEDBACK]:
                position = int.from_bytes(data[:4], "little")
                self.took(axis, before is not None and abs(position - before) > half_range)
                before = position

        axis.world.hub.attach(Port("listener", hear))
        return 0


MACHINE_ACTIONS: dict[str, type[InjectionAction]] = {
    "gains": Gains,
    "tell": GiveCommand,
    "sine": Sine,
    "dies": Dies,
    "step": Step,
    "wakes_late": WakesLate,
    "configure": Configure,
    "counter_wraps": CounterWraps,
    "load": Load,
}


# --- Gain-set files --------------------------------------------------------------------------------------------------
# Actions on gain-set files: what befalls them between the moment they are stored and the moment they are to run.


_LOADED, _OTHER = shipped("gains/demo_local.yaml"), shipped("gains/demo_pd_dob.yaml")


class Damage(StrEnum):
    """What becomes of a file."""

    CUT = "cut"  # only its first half is there
    SWAPPED = "swapped"  # another set stands under its name
    GONE = "gone"


def _cut(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    path.write_text(text[: len(text) // 2], encoding="utf-8")


def _swap(path: Path) -> None:
    aside = path.with_suffix(".aside")
    aside.write_bytes(_OTHER.read_bytes())
    aside.replace(path)


_DAMAGE: dict[Damage, Callable[[Path], None]] = {
    Damage.CUT: _cut,
    Damage.SWAPPED: _swap,
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
        stored = axis.call(Verb.GAINS_LOAD, name=_LOADED.name, text=_LOADED.read_text(encoding="utf-8"))
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
        data = yaml.safe_load(axis.machine.config.read_text(encoding="utf-8"))
        data["gains"]["initial"] = str(copy)
        axis.machine.config.write_text(yaml.safe_dump(data))
        return damaged


GAIN_FILE_ACTIONS: dict[str, type[InjectionAction]] = {"stored_gains": StoredGains, "configured_gains": ConfiguredGains}
