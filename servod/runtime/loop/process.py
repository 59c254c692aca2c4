"""The loop process: `python -m servod.runtime.loop.process FD PARENT`, with the plan on standard input.

One thread. Absolute deadlines; a missed period is skipped and counted, never made up for. Its death stops the master's
heartbeat, which the drive watches (0x1016); the death of its parent makes it brake, ramp down and switch off.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from typing import Protocol

from servod.common.clock import Clock, WallClock
from servod.common.end_signals import on_end_signals, restore_inherited_signals
from servod.common.units import NS_PER_S
from servod.runtime.fieldbus.bus.open import open_bus
from servod.runtime.loop.channel import Channel
from servod.runtime.loop.cycle import Cycle
from servod.runtime.loop.plan import LoopPlan
from servod.runtime.loop.realtime import apply_realtime, give_way

#: A supervisor whose beat stands still for this long counts as lost. Its death is seen within one cycle; this is for
#: one that hangs, which is not urgent: the loop has everything that it needs to control the axis.
SUPERVISOR_TIMEOUT_S = 1.0
#: Until its first beat it is on its way from the loop's start to its rounds, with sockets and files to open. Nobody can
#: command the axis before.
FIRST_BEAT_S = 5.0
#: Exit code of a loop that ended in order but did not see the drive switch off.
NOT_SEEN_OFF = 4


def supervisor_watch(channel: Channel, clock: Clock, parent: int) -> Callable[[], bool]:
    """A check, cheap enough for every cycle: is this process `parent`'s still, and does its beat begin and go on?"""
    patience_ns = int(FIRST_BEAT_S * NS_PER_S)
    last_beats, since_ns = channel.supervisor_beats(), clock.now_ns()

    def alive() -> bool:
        nonlocal last_beats, since_ns, patience_ns
        if os.getppid() != parent:
            return False
        beats = channel.supervisor_beats()
        if beats != last_beats:
            last_beats, since_ns, patience_ns = beats, clock.now_ns(), int(SUPERVISOR_TIMEOUT_S * NS_PER_S)
            return True
        return clock.now_ns() - since_ns < patience_ns

    return alive


class Paced(Protocol):
    """What `run` paces: the cycle, or the benchmark's probe of the wake-up."""

    @property
    def period_ns(self) -> int:
        """Time between two steps."""
        ...

    @property
    def finished(self) -> bool:
        """No further step is wanted."""
        ...

    def step(self, deadline_ns: int, woke_ns: int, skipped: int) -> None:
        """One period; `skipped` were missed before it."""
        ...


def run(cycle: Paced, clock: Clock) -> None:
    """Cycle after cycle until it is finished."""
    period_ns = cycle.period_ns
    deadline_ns = clock.now_ns() + period_ns
    while not cycle.finished:
        clock.sleep_until(deadline_ns)
        woke_ns = clock.now_ns()
        skipped = (woke_ns - deadline_ns) // period_ns
        deadline_ns += skipped * period_ns
        cycle.step(deadline_ns, woke_ns, skipped)
        deadline_ns += period_ns


def _plan_in_time() -> str:
    """What the supervisor writes at once; where it stands still before, this process ends (SIGALRM), as it does where
    the beat does not begin."""
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.setitimer(signal.ITIMER_REAL, FIRST_BEAT_S)
    text = sys.stdin.read()
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    return text


def main() -> int:
    """Entry point of the loop process; 0 when the drive was seen switched off at the end, else NOT_SEEN_OFF."""
    restore_inherited_signals()
    plan = LoopPlan.from_json(_plan_in_time())
    channel, clock = Channel(int(sys.argv[1])), WallClock()
    bus = open_bus(plan.config.bus)
    cycle = Cycle(plan, bus, clock, channel, supervisor_watch(channel, clock, int(sys.argv[2])))
    on_end_signals(cycle.shut_down)
    try:
        channel.publish_ready(apply_realtime(plan.config.cycle.cpu, plan.config.cycle.priority))
        run(cycle, clock)
    except BaseException:
        cycle.let_go()
        raise
    finally:
        give_way()
    bus.close()
    return 0 if cycle.seen_off else NOT_SEEN_OFF


if __name__ == "__main__":
    sys.exit(main())
