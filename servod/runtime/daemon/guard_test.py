"""The guards of the drive proven, not believed: the master falls silent on purpose and looks that the drive stops.

Instead of a daemon. The joint is at rest with the drive enabled at zero torque, because a drive without power has
nothing to show. What was proven, of which drive with which guards, and when, stands in a file beside the gain sets;
`enable` asks for a newer one where `amplifier.guard_test_days` says so.
"""

from __future__ import annotations

import hashlib
import json
import logging
import math
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypedDict

from servod.common.clock import Clock
from servod.common.errors import AnswerIsNo, BadInput, Unreachable
from servod.common.files import read_json, write_atomically
from servod.formats.config import AxisConfig
from servod.formats.config_wire import quick_stop_stays
from servod.formats.stopping import CYCLES_BEHIND
from servod.runtime.fieldbus.bus import Bus
from servod.runtime.fieldbus.cia import (
    CW_DISABLE_VOLTAGE,
    CW_FAULT_RESET,
    HEARTBEAT_BASE,
    SYNC_ID,
    Emcy,
    NmtState,
    Obj301,
    Obj402,
    decode_status_word,
)
from servod.runtime.fieldbus.devices import (
    AmplifierCommand,
    AmplifierFeedback,
    DriveInput,
    DriveState,
    Goal,
    NodePlan,
    SdoAccess,
)
from servod.runtime.fieldbus.master import BringUp, Master
from servod.runtime.fieldbus.master.planned import narrowed_by_stop
from servod.runtime.fieldbus.registry import amplifier_of
from servod.runtime.fieldbus.setup_tools import read_optional

log = logging.getLogger("servod.guards")

PROOF_NAME = "guard-proof.json"
_S_PER_DAY = 86_400.0
_MS = 1_000_000
#: Before each silence the drive stays enabled at rest with everything there, for so many times the longest guard's time
#: and cycles more, and no further than this from where it was [rad]: what ends by itself is no reaction to silence.
_REST_TIMES, _REST_CYCLES, _REST_RAD = 2.0, 50, 0.02
#: A guard acts not before this share of its time, however coarse its timer: what does is another reason to stop.
_EARLIEST_SHARE = 0.4
#: A drive that has stopped stays so in the silence that goes on, for its guard's time once more and at least this [ms].
_STAYS_OFF_MS = 50.0
#: With inputs to be read: they come by an event timer, and those that do not come count as active after 40 ms.
_INPUTS_S = 0.06
#: A machine that stands still lets the other guard act, or does not see when the drive stopped: tried again, so often.
_TRIES = 3
#: The drive is looked at once in a cycle; a look that is later by more is a machine that stood still.
_LOOK_CYCLES = 3
#: What the drive tells when each guard acts.
_GUARD_ERRORS = {"commands": Emcy.RPDO_TIME_OUT, "heartbeat": Emcy.HEARTBEAT_LOST}
_EVERYTHING = "everything"
_EXPECTED = (Emcy.HEARTBEAT_LOST, Emcy.RPDO_TIME_OUT)


@dataclass(frozen=True)
class GuardResult:
    """One silence: what stays away, the time that the guard against it has, when the drive had left the command, and
    when it was without power; in ms since the last frame. None: not within its time."""

    guard: str
    limit_ms: float
    left_ms: float | None
    off_ms: float | None

    @property
    def passed(self) -> bool:
        """The drive stopped by itself, in time."""
        return self.left_ms is not None and self.left_ms <= self.limit_ms and self.off_ms is not None


class _Silence(NamedTuple):
    """What stays away, the guard that is counted on against it, and its time."""

    name: str
    guard: str
    limit_ms: float


class _Seen(NamedTuple):
    """A result; `unsure`: in time or too late, by when the drive was looked at; `stalled`: since that was late."""

    result: GuardResult
    unsure: bool
    stalled: bool


class GuardTestStatus(TypedDict):
    """The proof of the guards as the status tells it; `text` says why it does not hold, empty where it does."""

    asked_for: bool
    holds: bool
    time: float | None
    text: str


class GuardTestRecord(TypedDict):
    """When the guards were tried (Unix time), and what that holds for."""

    time: float
    terms: dict[str, Any]


def terms(amplifier: NodePlan, identity: Any) -> dict[str, Any]:
    """What a proof holds for: this drive, with these ways and times to stop."""
    ways = {Obj402.QUICK_STOP_OPTION, Obj402.FAULT_REACTION_OPTION, Obj402.ABORT_CONNECTION, Obj301.ERROR_BEHAVIOUR,
            Obj301.HEARTBEAT_CONSUMER, Obj301.RPDO_PARAMETER}  # fmt: skip
    guards = [list(guard) for guard in amplifier.facts.get("guards", ()) if guard[0] in ways]
    return {"drive": asdict(identity), "guards": guards, "silences": [s.name for s in silences_of(amplifier.facts)]}


def silences_of(facts: dict[str, Any]) -> list[_Silence]:
    """What a drive with these guards is tried with; nothing where none of them is counted on."""
    times = {"commands": facts.get("command_deadline_ms"), "heartbeat": facts.get("heartbeat_timeout_ms")}
    counted = [
        _Silence(guard, guard, float(limit_ms))
        for guard, limit_ms in times.items()
        if limit_ms and (guard == "commands" or facts.get("heartbeat_reaction"))
    ]
    if not counted:
        return []
    # As when this computer dies: without SYNC, too, at which alone some drives look at what else is overdue.
    return [*counted, min(counted, key=lambda silence: silence.limit_ms)._replace(name=_EVERYTHING)]


class GuardTest:
    """The test of one axis: `connect` gives a new connection to its bus, `report` hears what comes next."""

    def __init__(
        self, config: AxisConfig, connect: Callable[[], Bus], clock: Clock, report: Callable[[str], None] = log.info
    ) -> None:
        # As the daemon runs it: with the limits and the ramp that the stop is reckoned with.
        self._config, self._connect, self.clock, self._report = narrowed_by_stop(config)[0], connect, clock, report
        # A drive that holds for a brake that servod closes stays in quick stop active, and has stopped there.
        self._holds = config.amplifier.brake.by == "output" and quick_stop_stays(config.amplifier.quick_stop_option)
        self._longest_ms, self._caused = 0.0, False
        self.period_ns = config.cycle.period_us * 1000
        self.beat_ns = config.heartbeat.master_period_ms * _MS
        self.beat_id = HEARTBEAT_BASE + config.heartbeat.master_node_id

    def run(self) -> tuple[list[GuardResult], dict[str, Any]]:
        """Each guard that is counted on, and the terms that the result holds for.

        Raises Unreachable where the drive cannot be enabled, AnswerIsNo where the joint does not stay at rest, or the
        drive stops for another reason than the silence.
        """
        master = Master(self._config, self._connect(), self.clock, threaded=False)
        try:
            return self._run(master)
        finally:
            master.close()

    def _run(self, master: Master) -> tuple[list[GuardResult], dict[str, Any]]:
        results: list[GuardResult] = []
        up = master.bring_up()
        facts = up.amplifier.facts
        found = terms(up.amplifier, master.identity(up.amplifier.node_id))
        silences = silences_of(facts)
        if not silences:
            raise AnswerIsNo("no guard of this drive is counted on (amplifier.unguarded): there is nothing to test")
        self._longest_ms = max(silence.limit_ms for silence in silences)
        for number, silence in enumerate(silences):
            self._report(
                f"{number + 1} of {len(silences)}: {silence.name} will stay away; the drive has to stop within "
                f"{silence.limit_ms:g} ms by its guard of the {silence.guard}"
            )
            up = up if number == 0 else master.bring_up()
            results.append(self._tried(master, up, silence))
        self._reset_expected(master, up.amplifier.node_id)
        master.stand_down()
        return results, found

    def _tried(self, master: Master, up: BringUp, silence: _Silence) -> GuardResult:
        """One silence, again where this machine was in the way. Raises Unreachable where it always was."""
        late: GuardResult | None = None
        for number in range(_TRIES):
            if number:
                self._report(f"again, {number + 1} of {_TRIES}: this machine stood still, or another guard acted first")
            seen = self._try(master, up, silence)
            if seen is not None and not seen.unsure:
                return seen.result
            late = late or (seen.result if seen is not None and not seen.stalled else None)
            up = master.bring_up()
        if late is not None:
            return late
        raise Unreachable(
            f"{silence.name}: each time the drive told that another of its guards acted first, or was looked at too "
            "late, since this machine stood still meanwhile: end what else runs here, then test again"
        )

    def _try(self, master: Master, up: BringUp, silence: _Silence) -> _Seen | None:
        """Bring the drive to zero torque at rest, fall silent, and look until it is without power. However that ends,
        the drive is switched off. None where another guard acted."""
        bus, sdo = self._connect(), master.sdo(up.amplifier.node_id)
        drive = _Cycles(self, bus, up)
        with ExitStack() as end:  # whatever fails of these, the others are done
            end.callback(bus.close)
            end.callback(sdo.write, Obj402.CONTROL_WORD, 0, CW_DISABLE_VOLTAGE)  # its PDOs may have ended
            end.callback(drive.run, Goal.OFF, 20)
            end.callback(setattr, drive, "silent", "")
            self._enable(drive, sdo)
            if not self._rests(drive, sdo):
                return None
            drive.silent, self._caused = silence.name, True
            left_ms, off_ms, error_codes, before_ms = self._look(sdo, drive, silence)
            _refuse_other_reason(silence, error_codes, sdo)
        if left_ms is not None and left_ms < _EARLIEST_SHARE * silence.limit_ms:
            raise AnswerIsNo(
                f"{silence.name}: the drive left the command {left_ms:.1f} ms into the silence, and its guard acts "
                f"after {silence.limit_ms:g} ms: it stops for another reason, which says nothing of its guard"
            )
        # The first that it tells is the one that acted: others may follow while its ramp lasts.
        acted = next((code for code in error_codes if code in _GUARD_ERRORS.values()), None)
        if silence.name != _EVERYTHING and acted not in (None, _GUARD_ERRORS[silence.guard]):
            return None
        # What the stop is reckoned with, and no more (servod.formats.stopping).
        most_ms = silence.limit_ms + CYCLES_BEHIND * self.period_ns / _MS
        unsure = left_ms is not None and before_ms <= most_ms < left_ms
        stalled = left_ms is not None and left_ms - before_ms > _LOOK_CYCLES * self.period_ns / _MS
        return _Seen(GuardResult(silence.name, most_ms, left_ms, off_ms), unsure, stalled)

    def _enable(self, drive: _Cycles, sdo: SdoAccess) -> None:
        reads_inputs = self._config.amplifier.inputs.estop_bit is not None or self._config.amplifier.inputs.reports_sto
        off = drive.run(Goal.OFF, round(_INPUTS_S * 1e9 / self.period_ns) if reads_inputs else 10)
        _refuse_stopped(off)
        fault = off.state is DriveState.FAULT
        error = _error_code(sdo, off.error_code) if fault else 0
        unknown = error == 0 and self._caused  # no 0x603F: the fault that the silence before has caused
        if fault and error not in _EXPECTED and not unknown:
            raise Unreachable(
                f"the drive is in a fault of its own (error 0x{error:04X}), which this test does not reset: remove its "
                "cause, then `servoctl enable --reset-fault`"
            )
        drive.run(Goal.OFF, 1, reset=fault)
        for _ in range(round(self._config.amplifier.enable_timeout_s * 1e9 / self.period_ns)):
            feedback = drive.run(Goal.ENABLED, 1)
            _refuse_stopped(feedback)
            if feedback.state is DriveState.OPERATION_ENABLED and feedback.goal_reached:
                break
        else:
            raise Unreachable(f"the drive is {feedback.state.name}, not enabled, so its guards cannot be tried")

    def _rests(self, drive: _Cycles, sdo: SdoAccess) -> bool:
        """Whether the drive stays enabled, at rest, with nothing silent; False where a guard acted since this machine
        stood still. Raises AnswerIsNo where it leaves operation for another reason, or the joint moves."""
        start_rad = drive.run(Goal.ENABLED, 1).position_rad
        for _ in range(_REST_CYCLES + round(_REST_TIMES * self._longest_ms * _MS / self.period_ns)):
            feedback = drive.run(Goal.ENABLED, 1)
            state = decode_status_word(sdo.read(Obj402.STATUS_WORD))  # its PDOs may have ended
            if state is not DriveState.OPERATION_ENABLED:
                code = feedback.error_code or _error_code(sdo, 0)
                if code in _EXPECTED:
                    return False
                _refuse_stopped(feedback)
                raise AnswerIsNo(
                    f"the drive leaves operation by itself ({state.name}, error 0x{code:04X}) while nothing is silent: "
                    "remove the cause, then test again"
                )
            _refuse_stopped(feedback)
            if abs(feedback.position_rad - start_rad) > _REST_RAD:
                raise AnswerIsNo("the joint moves without torque: hold its load (brake, support), then test again")
        return True

    def _look(
        self, sdo: SdoAccess, drive: _Cycles, silence: _Silence
    ) -> tuple[float | None, float | None, list[int], float]:
        """When the drive had left the command at the latest, when it was without power, the codes that it told, and
        until when at least it had not left. Its status word is asked for by SDO in each cycle: PDOs may end with the
        reaction."""
        last_ns, limit_ms, error_codes = drive.last_ns[silence.guard], silence.limit_ms, list[int]()
        before_ms = 0.0
        left_ms: float | None = None
        most_ms = 2.0 * limit_ms + 1e3 * self._config.amplifier.enable_timeout_s
        while (since_ms := (self.clock.now_ns() - last_ns) / _MS) < most_ms:
            feedback = drive.run(Goal.ENABLED, 1)
            # Without SYNC the feedback grows old, and inputs come by an event timer all the same.
            if left_ms is None and (feedback.age_cycles == 0 or silence.name == _EVERYTHING):
                _refuse_stopped(feedback)
            error_codes.append(feedback.error_code)
            asked_ms = (self.clock.now_ns() - last_ns) / _MS
            state = decode_status_word(sdo.read(Obj402.STATUS_WORD))
            answered_ms = (self.clock.now_ns() - last_ns) / _MS
            if state is DriveState.OPERATION_ENABLED:
                before_ms = asked_ms
            elif left_ms is None:
                left_ms = answered_ms
            if self._stopped(state):
                off_ms = answered_ms if self._stays_off(sdo, drive, limit_ms) else None
                return left_ms, off_ms, error_codes, before_ms
            if left_ms is None and since_ms > 2.0 * limit_ms + 100.0:
                break
        return left_ms, None, error_codes, before_ms

    def _stopped(self, state: DriveState) -> bool:
        return state.unpowered or (self._holds and state is DriveState.QUICK_STOP_ACTIVE)

    def _stays_off(self, sdo: SdoAccess, drive: _Cycles, limit_ms: float) -> bool:
        """Whether a drive that has stopped stays so while the silence goes on; where commands go out, they say off."""
        end_ns = self.clock.now_ns() + round(max(limit_ms, _STAYS_OFF_MS) * _MS)
        while self.clock.now_ns() < end_ns:
            drive.run(Goal.QUICK_STOP if self._holds else Goal.OFF, 1)
            if not self._stopped(decode_status_word(sdo.read(Obj402.STATUS_WORD))):
                return False
        return True

    def _reset_expected(self, master: Master, node_id: int) -> None:
        """The fault that the test itself has caused goes; any other stays as it is."""
        sdo = master.sdo(node_id)
        fault = decode_status_word(sdo.read(Obj402.STATUS_WORD)) is DriveState.FAULT
        if fault and _error_code(sdo, 0) in (0, *_EXPECTED):
            sdo.write(Obj402.CONTROL_WORD, 0, CW_FAULT_RESET)
            sdo.write(Obj402.CONTROL_WORD, 0, CW_DISABLE_VOLTAGE)


def _error_code(sdo: SdoAccess, emcy_code: int) -> int:
    """What 0x603F says; `emcy_code`, which an EMCY told, where the drive does not have it."""
    code = read_optional(sdo, Obj402.ERROR_CODE)
    return emcy_code if code is None else code


def _refuse_other_reason(silence: _Silence, error_codes: Sequence[int], sdo: SdoAccess) -> None:
    """Raise AnswerIsNo where the drive says that it stopped for something else than the silence."""
    faulty = decode_status_word(sdo.read(Obj402.STATUS_WORD)) is DriveState.FAULT
    codes = [*error_codes, _error_code(sdo, 0) if faulty else 0]
    if other := next((code for code in codes if code and code not in _EXPECTED), None):
        raise AnswerIsNo(
            f"{silence.name}: the drive says that it stopped for another reason (error 0x{other:04X}), which says "
            "nothing of its guard: remove the cause, then test again"
        )


def _refuse_stopped(feedback: AmplifierFeedback) -> None:
    """Raise AnswerIsNo while somebody holds the axis stopped."""
    for drive_input, name, key in (
        (DriveInput.ESTOP, "the emergency stop", "amplifier.inputs.estop_bit"),
        (DriveInput.STO, "STO", "amplifier.inputs.sto_bit or sto_error"),
    ):
        if feedback.inputs & drive_input:
            raise AnswerIsNo(
                f"{name} is active, or its input is not heard of (0x60FD, {key}): release it, then test again"
            )


class _Cycles:
    """SYNC, command and heartbeat of a loop in its plainest form, any of which may fall `silent`."""

    def __init__(self, test: GuardTest, bus: Bus, up: BringUp) -> None:
        self._test, self._bus, self._clock = test, bus, test.clock
        self._amplifier = amplifier_of(up.amplifier)
        self.silent = ""
        self._next_ns = self._beat_ns = self._clock.now_ns()
        self.last_ns = {"commands": self._next_ns, "heartbeat": self._next_ns}  # when each went out last

    def run(self, goal: Goal, cycles: int, reset: bool = False) -> AmplifierFeedback:
        """So many cycles; the newest feedback."""
        for _ in range(cycles):
            self._next_ns = max(self._next_ns + self._test.period_ns, self._clock.now_ns())
            self._clock.sleep_until(self._next_ns)
            while (frame := self._bus.receive(0.0)) is not None:
                if frame.can_id in self._amplifier.receive_ids:
                    self._amplifier.on_frame(*frame)
            if self._clock.now_ns() >= self._beat_ns:
                self._beat_ns = self._clock.now_ns() + self._test.beat_ns
                self._send("heartbeat", self._test.beat_id, bytes((NmtState.OPERATIONAL,)))
            if self.silent != _EVERYTHING:
                self._bus.send(SYNC_ID, b"")
            feedback = self._amplifier.read()
            self._send("commands", *self._amplifier.write(AmplifierCommand(goal, 0.0, False, reset)))
        return feedback

    def _send(self, what: str, can_id: int, data: bytes) -> None:
        if self.silent not in (what, _EVERYTHING):
            self._bus.send(can_id, data)
            self.last_ns[what] = self._clock.now_ns()


# --- The proof ---


def keep_proof(config: AxisConfig, results: list[GuardResult], found: dict[str, Any]) -> Path:
    """Write the proof of a test that passed; where it is."""
    path = config.gains.directory / PROOF_NAME
    document = {"time": time.time(), "terms": found, "results": [asdict(result) for result in results]}
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, json.dumps({**document, "sha256": _sha256(document)}, indent=1) + "\n")
    return path


def _sha256(document: dict[str, Any]) -> str:
    """Over what the proof says; it protects from accident, as that of a gain set does."""
    return hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()


def read_record(config: AxisConfig) -> GuardTestRecord | str:
    """What the last test that passed has left, or why there is nothing that counts, in a sentence."""
    path = config.gains.directory / PROOF_NAME
    if not path.exists():
        return f"the drive's guards were never tested (there is no {path})"
    try:
        proof = read_json(path, "a proof by `servoctl guard-test`")
        stored_sha256 = proof.pop("sha256")
        if stored_sha256 == _sha256(proof) and math.isfinite(proof["time"]):
            return {"time": float(proof["time"]), "terms": proof["terms"]}
    except BadInput as error:
        return f"the proof of the drive's guards cannot be read ({error})"
    except (AttributeError, KeyError, TypeError, ValueError, OverflowError):  # a time of 400 digits
        pass
    return f"the proof of the drive's guards was changed since `servoctl guard-test` wrote it ({path})"


def guard_test_status(
    config: AxisConfig, proof: GuardTestRecord | str, found: dict[str, Any], now_s: float
) -> GuardTestStatus:
    """Whether `proof` holds for the drive that was brought up with the terms `found`, as of `now_s` (Unix)."""
    days = config.amplifier.guard_test_days
    tested_s, text = _judge(config, proof, found, now_s)
    return {"asked_for": days is not None, "holds": not text, "time": tested_s, "text": text}


def _judge(
    config: AxisConfig, proof: GuardTestRecord | str, found: dict[str, Any], now_s: float
) -> tuple[float | None, str]:
    if isinstance(proof, str):
        return None, proof
    tested_s = proof["time"]
    if {**proof["terms"], "silences": None} == {**found, "silences": None} != found != proof["terms"]:
        return tested_s, "the drive's guards were tested with other silences, by an earlier version of servod"
    if proof["terms"] != found:
        return tested_s, "the drive, its guards or their times are others than those that were tested"
    days = config.amplifier.guard_test_days
    if tested_s > now_s:
        return tested_s, "the test of the drive's guards is dated in the future: set the clock"
    if days is not None and now_s - tested_s > days * _S_PER_DAY:
        return tested_s, f"the test of the drive's guards is older than amplifier.guard_test_days ({days:g})"
    return tested_s, ""


def require_guard_test(proof: GuardTestStatus) -> None:
    """Raise Unreachable where the configuration asks for a proof that does not hold."""
    if proof["asked_for"] and not proof["holds"]:
        raise Unreachable(
            f"refused: {proof['text']}; stop the daemon, run `servoctl guard-test CONFIG` with nobody in reach, start "
            "it again"
        )
