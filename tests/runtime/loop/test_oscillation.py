"""A loop that swings by itself is told from one whose reference swings, by drawn motions and on the virtual axis."""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from servod.client.stepped import SteppedSession
from servod.client.virtual import virtual_config, virtual_session
from servod.common.faults import FAULTS, FaultCode
from servod.formats.gains.gain_set import load_gains
from servod.formats.model.axis_model import AxisModel, load_axis_model
from servod.formats.model.effects import JointElasticity
from servod.kernels.laws import LAWS
from servod.runtime.loop.axis_state import AxisState
from servod.runtime.loop.commands import Op, ReferenceKind
from servod.runtime.loop.oscillation import Oscillation, Turns

DT_S = 1e-3
FASTEST = 20.0
OSCILLATES = FAULTS[FaultCode.OSCILLATES].bit
SHIPPED = Path(__file__).parents[3] / "gains"
JOINT = load_axis_model(SHIPPED / "axes/table1_joint.yaml")
CERTIFIED = load_gains(SHIPPED / "demo_local_certified.yaml")
STIFF, STIFFER = (LAWS["pd"].number, 3, 20.0, 0.2, 0.0), (LAWS["pd"].number, 3, 40.0, 0.3, 0.0)
DESIGNED = (CERTIFIED.law.number, len(CERTIFIED.pack()), *CERTIFIED.pack())


def turning_points(values: list[int], least: int) -> int:
    """By the definition: the longest sequence of values that falls and rises in turn, each time by more than that."""
    falls, rises = [0] * len(values), [0] * len(values)  # the longest that ends here, its last step down or up
    for n, value in enumerate(values):
        for m in range(n):
            if values[m] - value > least:
                falls[n] = max(falls[n], rises[m] + 1)
            if value - values[m] > least and falls[m]:
                rises[n] = max(rises[n], falls[m] + 1)
    return max(falls + rises)


@given(st.lists(st.integers(-20, 20), min_size=1, max_size=60), st.integers(0, 10))
def test_turning_points_alternate_and_are_far_enough_apart(values: list[int], least: int) -> None:
    turns = Turns()
    at = [n for n, value in enumerate(values) if turns.step(value, least)]
    assert len(at) == turning_points(values, least)
    for n, (before, after) in enumerate(itertools.pairwise(at)):
        falls = n % 2 == 0  # the first turn ends a rise
        between = values[before : after + 1]
        assert (values[after] - min(between) if falls else max(between) - values[after]) > least


def first_alarm_s(torque: list[float], positions: list[float], swing_nm: float = 0.1) -> float:
    """When the loop was said to swing by itself, infinite: never. The reference as a table gives it: lines between its
    positions; where it jumps, as a step does, with no velocity."""
    found = Oscillation(swing_nm)
    found.begin(positions[0], math.inf)
    for n, (u, x, following) in enumerate(zip(torque, positions, [*positions[1:], positions[-1]], strict=True)):
        velocity = (following - x) / DT_S
        if found.look(u, x, velocity if abs(velocity) < FASTEST else 0.0, DT_S):
            return n * DT_S
    return math.inf


TONES = st.lists(st.tuples(st.floats(0.05, 30.0), st.floats(0.1, 2.0), st.floats(0.0, 6.0)), min_size=1, max_size=3)


@settings(max_examples=40)
@example([(2.0, 1.0, 0.0), (2.0, 2.0, 0.0), (18.0, 1.0, 0.0)], 0.0625, 0.5, 0.0)  # begins with a jump of the velocity
@given(TONES, st.floats(1e-4, 0.1), st.floats(0.01, 0.5), st.floats(0.0, 0.5))
def test_what_the_reference_asks_for_is_no_oscillation(
    tones: list[tuple[float, float, float]], inertia: float, dry: float, viscous: float
) -> None:
    """Ten seconds of tones (Hz, rad/s, phase), and the torque that inertia and friction need for them, all of it."""

    def at(order: int, t: float) -> float:
        return sum(
            v * (2.0 * math.pi * f) ** (order - 1) * math.sin(2.0 * math.pi * f * t + p + order * math.pi / 2.0)
            for f, v, p in tones
        )

    times = [n * DT_S for n in range(10_000)]
    speeds = [at(1, t) for t in times]
    torque = [inertia * at(2, t) + math.copysign(dry, v) + viscous * v for t, v in zip(times, speeds, strict=True)]
    assert first_alarm_s(torque, [at(0, t) for t in times], max(map(abs, torque))) == math.inf


@given(st.floats(4.0, 400.0), st.floats(0.0, 6.0), st.floats(0.0, 1.0))
def test_a_swing_beside_a_reference_at_rest_or_in_slow_motion_is_told(hz: float, phase: float, speed: float) -> None:
    times = [n * DT_S for n in range(3000)]
    own = [0.08 * math.sin(2.0 * math.pi * hz * t + phase) for t in times]
    half_s = max(0.05, 0.5 / hz)
    assert first_alarm_s(own, [0.2] * len(times)) <= 9.0 * half_s
    moving = [0.2 + speed * t for t in times]  # which begins with a jump of the speed
    assert first_alarm_s(own, moving) <= 12.0 * half_s


@given(st.floats(0.5, 400.0), st.floats(0.0, 6.0))
def test_a_swing_that_is_too_small_is_none(hz: float, phase: float) -> None:
    times = [n * DT_S for n in range(3000)]
    own = [0.049 * math.sin(2.0 * math.pi * hz * t + phase) for t in times]
    assert first_alarm_s(own, [0.0] * len(times)) == math.inf


@pytest.mark.parametrize(("hz", "zeta"), [(20.0, 0.06), (5.0, 0.06), (250.0, 0.01)])
def test_what_rings_down_after_each_step_is_none(hz: float, zeta: float) -> None:
    """A step of the reference each two seconds, and a torque that answers it with its limit and rings down; each swing
    of half the limit counts."""
    torque, positions = [], []
    for n in range(20_000):
        t = n * DT_S % 2.0
        torque.append(0.1 * math.exp(-2.0 * math.pi * hz * zeta * t) * math.cos(2.0 * math.pi * hz * t))
        positions.append(0.1 * ((n + 1999) // 2000))
    assert first_alarm_s(torque, positions, 0.05) == math.inf


@given(st.floats(0.1, 4.0), st.floats(25.0, 200.0), st.floats(0.0, 6.0))
def test_a_swing_beside_a_reference_that_swings_slowly_is_told(slow_hz: float, hz: float, phase: float) -> None:
    times = [n * DT_S for n in range(3000)]
    own = [0.12 * math.sin(2.0 * math.pi * hz * t + phase) for t in times]
    assert first_alarm_s(own, [0.1 * math.sin(2.0 * math.pi * slow_hz * t) for t in times]) <= 1.0


def test_an_enable_begins_anew_with_the_limit_that_is_in_force() -> None:
    found = Oscillation(None)
    found.begin(0.0, 0.2)
    own = [0.09 * math.sin(2.0 * math.pi * 20.0 * n * DT_S) for n in range(1000)]
    assert not any(found.look(u, 0.0, 0.0, DT_S) for u in own)
    found.begin(0.0, 0.1)
    assert any(found.look(u, 0.0, 0.0, DT_S) for u in own)
    found.begin(0.0, 0.1)
    assert not found.look(own[-1], 0.0, 0.0, DT_S)


def swings(hz: float, n: int) -> float:
    return 0.1 * math.sin(2.0 * math.pi * hz * n * DT_S)


def test_steps_that_come_again_and_again_hide_no_swing() -> None:
    """Each far below a count of any encoder: a client that wants to hide something, or a table of rounded numbers."""
    found, position = Oscillation(0.1), 0.0
    found.begin(0.0, 0.1)
    alarms = []
    for n in range(2000):
        position += 2e-9 * (n % 90 == 0)
        alarms.append(found.look(swings(100.0, n), position, 0.0, DT_S))
    assert any(alarms[:1000])


@pytest.mark.parametrize("every_s", [0.4, 0.8, 0.95, 1.5])
def test_what_rings_down_after_each_of_many_steps_is_none(every_s: float) -> None:
    """10 Hz with a damping ratio of 0.1, the first swing by the limit."""
    torque, positions = [], []
    for n in range(20_000):
        t = n * DT_S % every_s
        torque.append(0.1 * math.exp(-2.0 * math.pi * t) * math.cos(20.0 * math.pi * t))
        positions.append(0.1 * math.ceil(n * DT_S / every_s))
    assert first_alarm_s(torque, positions) == math.inf


@pytest.mark.parametrize(("injected_nm", "alarm"), [(0.0, True), (0.005, True), (0.05, False)])
def test_only_torque_that_is_worth_it_excuses_a_swing(injected_nm: float, alarm: bool) -> None:
    found = Oscillation(0.1)
    found.begin(0.0, 0.1)
    torques = [injected_nm * math.sin(2.0 * math.pi * 7.0 * n * DT_S) for n in range(2000)]
    assert any(found.look(swings(100.0, n), 0.0, 0.0, DT_S, own) for n, own in enumerate(torques)) is alarm


@pytest.mark.parametrize(("rad_s", "alarm"), [(0.0, True), (1.0, True), (12.0, False)])
def test_a_load_that_turns_with_the_joint_is_no_swing(rad_s: float, alarm: bool) -> None:
    """Torque for a weight goes to and fro twice a turn; as fast a swing of a joint that hardly moves is one."""
    found = Oscillation(0.1)
    found.begin(0.0, 0.1)
    hz = 12.0 / (2.0 * math.pi)
    assert any(found.look(swings(hz, n), rad_s * n * DT_S, rad_s, DT_S) for n in range(8000)) is alarm


# --- on the virtual axis ----------------------------------------------------------------------------------------------


def axis(
    folder: Path, joint: AxisModel = JOINT, law: tuple[float, ...] = STIFF, limits: dict[str, float] | None = None
) -> SteppedSession:
    """Enabled; both laws suit the joint of Table I."""
    config = virtual_config(folder, 100, 2**20)
    config = config.model_copy(update={"limits": config.limits.model_copy(update=limits or {})})
    session = virtual_session(joint, folder, 2**20, 1, config)
    session.send(Op.ACTIVATE, (1, *law))
    session.enable()
    session.run(0.1)
    session.clear()
    return session


STEP, PAPER = (ReferenceKind.STEP, 0.01, 4.0), (ReferenceKind.PAPER, 3.0)
SINES = [(ReferenceKind.SINE, 0.1, 2.0, 4.0), (ReferenceKind.SINE, 0.005, 12.0, 4.0)]


@pytest.mark.parametrize("law", [STIFF, DESIGNED], ids=["PD", "designed"])
@pytest.mark.parametrize("motion", [STEP, PAPER, *SINES])
def test_a_sound_axis_is_let_alone(tmp_path: Path, motion: tuple[float, ...], law: tuple[float, ...]) -> None:
    session = axis(tmp_path, law=law)
    session.send(Op.REFERENCE, motion)
    session.run(3.0)
    assert session.cycle.axis.state is AxisState.ENABLED
    assert not session.cycle.axis.latched & OSCILLATES


def test_a_table_that_waves_without_a_stop_is_let_alone(tmp_path: Path) -> None:
    """A cam: torque for inertia and viscous friction ten times a second, and the reference never reverses."""
    session = axis(tmp_path, limits={"oscillation_nm": 0.1, "position_max_rad": 10.0})
    times = [n * DT_S for n in range(3000)]
    positions = [1.3 * t + 1.2 / (10.0 * math.pi) * (1.0 - math.cos(10.0 * math.pi * t)) for t in times]
    session.load_trajectory(positions)
    session.send(Op.REFERENCE, (ReferenceKind.TABLE, len(positions), 0.0, 5.0))
    session.run(2.9)
    torque = [row.torque_nm for row in session.records[-1000:]]
    assert max(torque) - min(torque) > 0.1
    assert session.cycle.axis.state is AxisState.ENABLED


@pytest.mark.parametrize("added_nm", [0.0, 0.2])
def test_torque_that_an_experiment_injects_is_no_oscillation(tmp_path: Path, added_nm: float) -> None:
    session = axis(tmp_path, limits={"oscillation_nm": 0.1})
    added = [added_nm * math.sin(10.0 * math.pi * n * DT_S) for n in range(3000)]
    session.load_trajectory([0.0] * 3000 + added)
    session.send(Op.REFERENCE, (ReferenceKind.EXCITE, 3000, 0.0, 0.0, 0.5))
    session.run(2.5)
    assert session.cycle.reference.active
    assert session.cycle.axis.state is AxisState.ENABLED


def loose_coupling(hz: float) -> AxisModel:
    """Half of the inertia behind a spring that resonates there."""
    half = JOINT.inertia / 2.0
    stiffness = (2.0 * math.pi * hz) ** 2 * half / 2.0
    spring = JointElasticity(stiffness=stiffness, load_inertia=half, damping=0.01 * math.sqrt(stiffness * half))
    return JOINT.model_copy(update={"joint_elasticity": spring})


@pytest.mark.parametrize(
    ("joint", "law", "limits", "within_s"),
    [
        pytest.param(JOINT, STIFF, {"torque_rate_nm_per_s": 1.5, "oscillation_nm": 0.15}, 2.0, id="torque rate"),
        pytest.param(JOINT.model_copy(update={"delay_s": 0.004}), STIFFER, {}, 1.0, id="delay"),
        pytest.param(loose_coupling(250.0), DESIGNED, {}, 1.0, id="coupling"),
    ],
)
def test_an_unstable_loop_is_stopped_by_the_drive(
    tmp_path: Path, joint: AxisModel, law: tuple[float, ...], limits: dict[str, float], within_s: float
) -> None:
    session = axis(tmp_path, joint, law, limits)
    session.send(Op.REFERENCE, STEP)
    session.run(within_s)
    assert session.cycle.axis.latched & OSCILLATES
    session.run(1.0)
    assert session.cycle.axis.state is AxisState.FAULT
    assert abs(session.world.truth().velocity_rad_s) < 1e-2
    first = next(n for n, row in enumerate(session.records) if row.faults & OSCILLATES)
    assert all(row.torque_nm == 0.0 for row in session.records[first:])
    session.enable(reset_fault=True)
    session.run(0.2)
    assert session.cycle.axis.state is AxisState.ENABLED
    held = axis(tmp_path, joint, law, limits | {"oscillation_nm": 0.6})  # twice the torque limit: never
    held.send(Op.REFERENCE, STEP)
    held.run(within_s)
    assert held.cycle.axis.state is AxisState.ENABLED


def test_the_law_that_the_loop_began_with_is_judged_too(tmp_path: Path) -> None:
    before = virtual_session(JOINT.model_copy(update={"delay_s": 0.004}), tmp_path, 2**20, 1)
    before.close()
    session = SteppedSession(before.config, before.world, int(STIFFER[0]), STIFFER[2:])
    session.enable()
    session.send(Op.REFERENCE, STEP)
    session.run(1.0)
    assert session.cycle.axis.latched & OSCILLATES


def test_a_swing_of_a_torque_that_the_way_to_rest_narrows_is_told(tmp_path: Path) -> None:
    """The drive goes on for 100 ms by itself, so the joint may have less than half of limits.torque_nm."""
    config = virtual_config(tmp_path, 100, 2**20)
    limits = {"torque_nm": 0.3, "speed_rad_s": 3.0, "position_min_rad": -0.6, "position_max_rad": 0.6}
    config = config.model_copy(
        update={
            "limits": config.limits.model_copy(update=limits),
            "heartbeat": config.heartbeat.model_copy(update={"command_deadline_ms": 0, "drive_timeout_ms": 100}),
            "model": SHIPPED / "axes/demo_joint.yaml",
        }
    )
    session = virtual_session(load_axis_model(SHIPPED / "axes/demo_joint.yaml"), tmp_path, 2**20, 1, config)
    session.send(Op.ACTIVATE, (1, LAWS["pd"].number, 3, 2.5, 0.12, 0.0))
    session.enable()
    session.run(0.2)
    assert session.cycle.limits.at_rest_nm < 0.5 * session.cycle.limits.torque_nm
    session.send(Op.ACTIVATE, (2, LAWS["pd"].number, 3, 2.5, 2.5, 0.0))
    session.send(Op.REFERENCE, (ReferenceKind.STEP, 0.02, 4.0))
    session.run(2.0)
    assert session.cycle.axis.latched & OSCILLATES
