"""The program `servod --config axis.yaml`: from a configuration file to a supervised axis, and back again in reverse.

Started by systemd, or by hand to try it; above the supervisor. The order is: read and check every file, take the locks,
reach the bus, bring the nodes up, start the loop, open the sockets. What fails says so in one line, and nothing that
was begun is left behind. Arguments, signals, exit codes and log lines stand here as well.
"""

from __future__ import annotations

import argparse
import logging
import os
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from servod import __version__
from servod.common.arguments import ArgumentParser
from servod.common.clock import WallClock
from servod.common.end_signals import on_end_signals, restore_inherited_signals
from servod.common.errors import BadInput, ServodError, Unreachable
from servod.common.faults import FaultCode, fault_text
from servod.common.files import named_in, reason
from servod.common.yaml import read_text
from servod.formats.config import AxisConfig, load_config
from servod.formats.config_guards import weakened
from servod.formats.gains.gain_set import load_gains, require_fit
from servod.formats.model.axis_model import load_axis_model
from servod.formats.recording.incidents import of_abrupt_end
from servod.formats.recording.run_mark import RunMark
from servod.formats.stopping import UNKNOWN, Stopping
from servod.formats.wiring import with_expected
from servod.runtime.daemon.fault_watch import memory_of_incidents
from servod.runtime.daemon.gain_bank import GainBank
from servod.runtime.daemon.lock import InstanceLock
from servod.runtime.daemon.nodes import Nodes
from servod.runtime.daemon.notify import Notifier
from servod.runtime.daemon.recorder import Recorder
from servod.runtime.daemon.supervisor import Context, Supervisor
from servod.runtime.daemon.waiting import SHOWN_S, BringUpFailure, shown_s_after, wait_for_nodes
from servod.runtime.fieldbus.bus.open import open_bus
from servod.runtime.fieldbus.master import BringUp, Master, master_ids, start_ids
from servod.runtime.fieldbus.master.planned import check_names, narrowed_by_stop, planned_bus_load, stopping_as_found
from servod.runtime.loop.handle import LoopHandle
from servod.runtime.loop.plan import LoopPlan

log = logging.getLogger("servod")

_RECORDER_START_S = 5.0
#: How long a thread that works on files may hold the interpreter while the supervisor wants it (Python's own: 5 ms, and
#: that for each system call of the supervisor).
_SWITCH_S = 2e-4


def check(path: Path) -> AxisConfig:
    """Read and check the configuration and every file that it names. Raises BadInput."""
    config = load_config(path)
    for note in check_names(config, str(path)):
        log.warning("%s", note)
    with named_in(f"{path}: gains.initial"):
        initial = load_gains(config.gains.initial)
    with named_in(f"{path}: gains"):
        require_fit(initial, config, str(config.gains.initial))
    if config.model is not None:
        with named_in(f"{path}: model"):
            load_axis_model(config.model)
    planned_bus_load(config, str(path))
    narrowed_by_stop(config)
    return config


def run(path: Path, on_ready: Callable[[Supervisor], None], waits: bool = False) -> int:
    """Run the axis that `path` configures until it ends; returns the exit code.

    Raises ServodError when it cannot begin. `on_ready` is told the supervisor before it begins, for signals. With
    `waits` it waits for bus and nodes at the start, and begins again when they were lost and are back.
    """
    config = check(path)
    incidents, notifier = memory_of_incidents(), Notifier()
    with ExitStack() as stack:
        lock = stack.enter_context(InstanceLock(config))
        mark = stack.enter_context(RunMark(config.recorder.directory, config.name))
        found = None if mark.found is None else of_abrupt_end(mark.found, config.name)
        if found is not None:  # at once: a drive that is still booting may end this start
            log.error("fault %s: %s", found.first.code.name, found.first.detail)
        _leave_core_to_loop(config.cycle.cpu)
        sys.setswitchinterval(_SWITCH_S)
        return _run_on(config, path, Context(lock, notifier, incidents, SHOWN_S if waits else None, found), on_ready)


def _run_on(config: AxisConfig, path: Path, context: Context, on_ready: Callable[[Supervisor], None]) -> int:
    """The axis, and for a daemon that waits again and again; the exit code.

    What fails while nodes that answer are brought up is waited for as well: a drive may be heard before it can be set
    up, and a start that ends uses up one of the few that the service manager allows.
    """
    failure: BringUpFailure | None = None
    while True:
        if context.shown_s is not None:
            wait_for_nodes(config, context.notifier, context.incidents, failure)
        began, bank = time.monotonic(), GainBank(config, begins=False)
        with ExitStack() as held:
            try:
                master, plans = _bring_up(config, held)
            except ServodError as error:
                if context.shown_s is None or isinstance(error, BadInput):
                    raise
                failure = BringUpFailure.after(error, failure)
                continue
            failure = None
            nodes = Nodes(master, plans)
            bank.know(nodes.devices())
            supervisor = _begin(config, path, nodes, bank, context, held, on_ready)
            code = supervisor.run()
        if code is not None or context.shown_s is None:
            return code or 0
        _end_start_on_signals()
        if supervisor.stopping:
            return 0
        shown_s = shown_s_after(context.shown_s, time.monotonic() - began)
        context = context._replace(shown_s=shown_s, found=None, carried=supervisor.carried)


def _bring_up(config: AxisConfig, held: ExitStack) -> tuple[Master, BringUp]:
    """Both nodes, operational; `held` leaves the bus. Raises ServodError."""
    narrowed, _ = narrowed_by_stop(config)
    start_bus = open_bus(config.bus, start_ids(config))
    try:
        bus = open_bus(config.bus, master_ids(config))
    except BaseException:
        start_bus.close()
        raise
    master = Master(narrowed, bus, WallClock(), threaded=False, start_bus=start_bus)
    held.callback(master.close)
    plans = master.bring_up()
    for line in plans.report:
        log.info("%s", line)
    return master, plans


def _begin(
    config: AxisConfig,
    path: Path,
    nodes: Nodes,
    bank: GainBank,
    context: Context,
    held: ExitStack,
    on_ready: Callable[[Supervisor], None],
) -> Supervisor:
    """Recorder, loop and supervisor of nodes that are operational; `held` closes what they stand on. `config` is as it
    is written; what follows has its limits as they can be kept."""
    recorder = _recorder(config, path, bank)
    held.callback(recorder.close)
    try:
        config, stopping = stopping_as_found(config, nodes.plans.amplifier)
    except ServodError:
        nodes.stand_down()
        raise
    if context.carried:
        log.warning("still latched from before, until `servoctl enable --reset-fault`: %s", fault_text(context.carried))
    for line in [UNKNOWN] if stopping is None else stopping.lines():
        log.warning("%s", line)
    with ExitStack() as undo:
        supervisor = _supervise(config, stopping, nodes, bank, recorder, context, undo)
        bank.begin()  # a start that failed leaves the active set as it was
        on_ready(supervisor)
        undo.pop_all()
    return supervisor


def _supervise(
    config: AxisConfig,
    stopping: Stopping | None,
    nodes: Nodes,
    bank: GainBank,
    recorder: Recorder,
    context: Context,
    undo: ExitStack,
) -> Supervisor:
    """Loop and supervisor on nodes that are operational; `undo` is what to do when that fails half-way."""
    gains = bank.newest.gains
    plans = nodes.plans
    expected = with_expected(config)
    for line in weakened(expected, load_axis_model(config.model) if config.model else None):
        log.warning("%s", line)
    stop = None if stopping is None else stopping.facts
    plan = LoopPlan(
        expected,
        plans.amplifier,
        plans.encoder,
        int(gains.law.number),
        gains.pack(),
        stop=stop,
        carried=context.carried,
    )
    try:
        loop = LoopHandle(plan)
    except OSError as error:  # a limit on the size of files holds for shared memory, too
        raise Unreachable(f"shared memory for the loop cannot be made ({reason(error)}); see `ulimit -a`") from None
    undo.callback(loop.close)
    undo.callback(_give_back, nodes, loop)
    _start_loop(loop, nodes)
    return Supervisor(config, stopping, nodes, loop, bank, recorder, context)


def _give_back(nodes: Nodes, loop: LoopHandle) -> None:
    """The axis was never enabled; still only a drive that the loop saw off may forget the master's heartbeat."""
    if loop.alive() and loop.stop() != 0:
        nodes.switch_off()
    else:
        nodes.stand_down()


def _leave_core_to_loop(cpu: int | None) -> None:
    """Keep the supervisor off the core that the loop pins itself to, where there is another one."""
    others = os.sched_getaffinity(0) - {cpu}
    if others:
        os.sched_setaffinity(0, others)


def _recorder(config: AxisConfig, path: Path, bank: GainBank) -> Recorder:
    recorder = Recorder(config.recorder, config.name, config.cycle.period_us)
    recorder.try_folder()
    recorder.set_attachment("config.yaml", read_text(path).encode())
    recorder.set_attachment("gains.yaml", bank.newest.text.encode())
    if config.model is not None:
        recorder.set_attachment("model.yaml", read_text(config.model).encode())
    if config.recorder.always:
        _record_from_the_start(recorder)
    return recorder


def _record_from_the_start(recorder: Recorder) -> None:
    """A recording that cannot begin is told, and no reason for the axis not to run."""
    try:
        log.info("recording to %s", recorder.start().result(_RECORDER_START_S))
    except (ServodError, TimeoutError) as error:
        log.error("fault %s: %s", FaultCode.RECORDER_FAILED.name, error or "the disk does not answer")


def _start_loop(loop: LoopHandle, nodes: Nodes) -> None:
    loop.start(nodes.look_for_foreign_traffic)
    nodes.hand_over()
    for grant in loop.grants:
        log.log(
            logging.INFO if grant.granted else logging.WARNING,
            "real time: %s %s: %s",
            grant.name,
            "granted" if grant.granted else "refused",
            grant.reason,
        )


# --- The journal -----------------------------------------------------------------------------------------------------
# Log lines for the journal: to standard error, with systemd's level prefix where the journal reads it.


#: sd-daemon(3): "<N>" at the start of a line is its syslog priority.
_PRIORITY = {logging.DEBUG: 7, logging.INFO: 6, logging.WARNING: 4, logging.ERROR: 3, logging.CRITICAL: 2}


def harmless(text: str) -> str:
    """`text` in one line, whatever stands in it: nothing that begins a new entry, or acts on the reader's terminal."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in " ".join(text.splitlines()))


class _JournalFormatter(logging.Formatter):
    """One line per message, whatever is in it."""

    def __init__(self, to_journal: bool) -> None:
        super().__init__("%(message)s" if to_journal else "%(asctime)s %(levelname)s %(message)s")
        self._to_journal = to_journal

    def format(self, record: logging.LogRecord) -> str:
        """The line, its priority in front when the journal reads it."""
        line = harmless(super().format(record))
        return f"<{_PRIORITY.get(record.levelno, 6)}>{line}" if self._to_journal else line


def print_error(text: str) -> None:
    """The one line that ends a program, on standard error."""
    prefix = f"<{_PRIORITY[logging.ERROR]}>" if "JOURNAL_STREAM" in os.environ else ""
    print(f"{prefix}servod: {harmless(' '.join(text.split()))}", file=sys.stderr, flush=True)


def set_up_logging() -> None:
    """Send the daemon's log lines to standard error; libraries speak from WARNING on."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_JournalFormatter("JOURNAL_STREAM" in os.environ))
    logging.basicConfig(level=logging.WARNING, handlers=[handler], force=True)
    logging.getLogger("servod").setLevel(logging.INFO)


_EXAMPLE = """\
example:
  servod --config /etc/servod/config/can0.yaml          run the axis until SIGTERM
  servod --config /etc/servod/config/can0.yaml --wait   the same as a service: wait for late nodes, begin again
  servod --config /etc/servod/config/can0.yaml --check  only check the configuration and the files it names

exit codes: 0 done, 2 bad usage or input, 3 bus, device or loop cannot be reached or was lost
"""


def parser() -> argparse.ArgumentParser:
    """What `servod` takes; the reference of the command line prints it too."""
    found = ArgumentParser(
        prog="servod",
        description="Runs one servo axis over CANopen: 1 kHz friction-compensating control, supervised and recorded.",
        epilog=_EXAMPLE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    found.add_argument("--config", type=Path, required=True, metavar="FILE", help="axis configuration (YAML)")
    found.add_argument(
        "--wait",
        action="store_true",
        help="wait for bus and nodes that are late, and begin again, disabled, when they were lost and are back",
    )
    found.add_argument("--check", action="store_true", help="check the configuration and end")
    found.add_argument("--version", action="version", version=f"servod {__version__}", help="print the version")
    return found


def _end_start_on_signals() -> None:
    """Until the supervisor takes over, they are as Ctrl-C: what was begun is undone."""
    on_end_signals(_interrupt)


def _interrupt() -> None:
    raise KeyboardInterrupt


def _stop_on_signals(supervisor: Supervisor) -> None:
    on_end_signals(supervisor.request_stop)


def main(arguments: list[str] | None = None) -> int:
    """Run the daemon; returns the exit code, with one line on standard error when it is not 0."""
    set_up_logging()
    restore_inherited_signals()
    try:
        options = parser().parse_args(arguments)
        if options.check:
            config = check(options.config)
            print(f"{options.config}: good; axis {config.name} on {config.bus.interface} {config.bus.channel}")
            return 0
        _end_start_on_signals()
        return run(options.config, _stop_on_signals, options.wait)
    except ServodError as error:
        print_error(str(error))
        return error.exit_code
    except KeyboardInterrupt:
        return 130


if __name__ == "__main__":
    sys.exit(main())
