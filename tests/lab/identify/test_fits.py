"""Fits against what they must find: closed forms against brute force, intervals against known scatter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

from servod.common.errors import AnswerIsNo
from servod.common.yaml import validate
from servod.formats.model.axis_model import AxisModel
from servod.kernels.physics.plant import Plant
from servod.lab.identify import analysis
from servod.lab.identify.estimate import AT_END, Estimate, bound_notes, estimate, jackknife, sandwich
from servod.lab.identify.fits import bristle, cogging, curve, elastic, presliding, response
from servod.lab.identify.fits.break_away import BreakAwayFit
from servod.lab.identify.fits.bristle import Bristle, Moved, dry_columns, follow
from servod.lab.identify.fits.elastic import Elastic
from servod.lab.identify.fits.friction_map import FittedHarmonic, Side
from servod.lab.identify.fits.presliding import bend_factor, fundamental
from servod.lab.identify.fits.response import Rigid, response_of
from servod.lab.identify.shapes import multisine
from servod.lab.identify.trace import ExperimentKind, RecordedMotion, acting_torque, smooth

PERIOD_S = 1e-3


@pytest.mark.parametrize(
    "joint",
    [Rigid(1e-3, 0.05, 0.0013, 0.0), Rigid(1e-3, 0.05, 0.002, 0.001), Rigid(0.1, -2.0, 0.0005, 0.0)],
)
def test_the_sampled_response_is_that_of_a_simulated_pulse(joint):
    h, way, position, velocity, torque = 1e-6, [], 0.0, 0.0, 0.0
    held, late = round(PERIOD_S / h), round(joint.delay_s / h)
    for step in range(6 * held):
        if step % held == 0:
            way.append(position)
        command = 1.0 if 0 <= step - late < held else 0.0
        torque = torque + (command - torque) * h / joint.lag_s if joint.lag_s else command
        velocity += h * (torque - joint.viscous * velocity) / joint.inertia
        position += h * velocity
    radius, count = 1.2, 256
    z = radius * np.exp(2j * np.pi * np.arange(count) / count)
    response = response_of(joint, np.log(z) / (2j * np.pi * PERIOD_S), PERIOD_S)
    pulse = np.fft.ifft(response).real * radius ** np.arange(count)
    assert pulse[:5] == pytest.approx(np.diff(way), rel=2e-3, abs=1e-6 / joint.inertia * 1e-3)


@pytest.mark.parametrize("share", [0.2, 0.4, 0.6])
def test_the_bend_of_the_dahl_loop_is_that_of_the_plant(share):
    friction = {"kind": "lugre", "sigma0": 950.0, "sigma1": 1.0, "coulomb": 0.045, "static": 0.07}
    model = validate({"inertia": 1e-3, "delay_s": 0.0, "friction": friction}, AxisModel, "joint")
    plant, amplitude, frequency_hz = Plant(model), share * 0.07, 8.0
    t = np.arange(1500) * PERIOD_S
    way = []
    for torque in amplitude * np.sin(2.0 * np.pi * frequency_hz * t):
        way.append(plant.position_rad)
        plant.advance(float(torque), PERIOD_S)
    softened = abs(fundamental(np.array(way[500:]), frequency_hz, PERIOD_S)) * 950.0 / amplitude
    assert bend_factor(amplitude, 0.07, 0.07) == pytest.approx(softened, rel=0.01)


def test_acting_torque_is_the_held_command_averaged_over_the_sample():
    command = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    assert acting_torque(command, 1.0 * PERIOD_S, PERIOD_S) == pytest.approx([0, 0, 0, 0.5, 0.5, 0])
    assert acting_torque(command, 1.3 * PERIOD_S, PERIOD_S) == pytest.approx([0, 0, 0, 0.2, 0.8, 0])


def test_smoothing_differentiates_a_parabola_exactly():
    t = np.arange(400) * PERIOD_S
    s = smooth(t, np.full(400, 0.02), 0.3 + 0.5 * t + 2.0 * t**2, 0.001, 0.01)
    assert s.velocity == pytest.approx(0.5 + 4.0 * s.t_s)
    assert s.acceleration == pytest.approx(4.0, rel=1e-6)
    assert s.torque == pytest.approx(0.02)


def test_intervals_hold_their_promise():
    rng, held = np.random.default_rng(5), 0
    for _ in range(400):
        parts = list(rng.normal(3.0, 0.5, 12))
        value, deviation = jackknife(lambda p: np.array([np.mean(p)]), parts)
        held += estimate(float(value[0]), float(deviation[0]), 11, "1").holds(3.0)
    assert held / 400 == pytest.approx(0.95, abs=0.03)


def test_the_sandwich_sees_errors_that_parts_share():
    rng = np.random.default_rng(6)
    parts = np.repeat(np.arange(40), 25)
    spread = []
    design = np.ones((1000, 1))
    for _ in range(200):
        noise = rng.normal(0.0, 1.0, 40)[parts] + rng.normal(0.0, 0.1, 1000)
        spread.append(noise.mean())
    residual = noise - noise.mean()
    deviation = np.sqrt(sandwich(design, residual, np.ones(1000), parts)[0, 0])
    assert deviation == pytest.approx(np.std(spread), rel=0.35)


def test_cogging_orders_are_found_beside_friction_and_none_where_there_is_none():
    rng = np.random.default_rng(7)
    x = np.linspace(-1.0, 1.0, 3000)
    base = np.column_stack([x > 0.0, x <= 0.0]).astype(float)
    torque = base @ [0.05, -0.04] + rng.normal(0.0, 2e-4, len(x))
    assert cogging.find_orders(base, x, torque, 60) == []
    torque = torque + 0.002 * np.sin(22.0 * x + 0.3) + 0.001 * np.sin(7.0 * x)
    assert sorted(cogging.find_orders(base, x, torque, 60)) == [7, 22]


def test_gravity_is_found_on_less_than_a_turn():
    rng = np.random.default_rng(8)
    x = np.concatenate([np.linspace(-1.0, 1.0, 1500), np.linspace(1.0, -1.0, 1500)])
    forward = np.arange(3000) < 1500
    base = np.column_stack([forward, ~forward]).astype(float)
    torque = base @ [0.05, -0.04] + 0.02 * np.sin(x + 0.3) + rng.normal(0.0, 2e-4, len(x))
    assert cogging.find_orders(base, x, torque, 60) == [cogging.GRAVITY]


def test_a_stiff_spring_is_a_rigid_joint():
    frequency = np.array([3.0, 10.0, 30.0, 60.0, 150.0])
    sprung = elastic.response_of(Elastic(1e-3, 0.05, 0.0016, 2e4, 0.3, 0.05), frequency, PERIOD_S)
    assert sprung == pytest.approx(response_of(Rigid(1e-3, 0.05, 0.0016, 0.0), frequency, PERIOD_S), rel=1e-4)


@pytest.mark.parametrize(
    "joint",
    [
        Elastic(1e-3, 0.05, 0.0015, 60.0, 0.3, 0.03),
        Elastic(0.1, 5.0, 0.002, 95.0, 0.6, 0.02),
        Elastic(1e-3, 0.05, 0.0015, 140.0, 0.2, 0.02),
    ],
)
def test_the_resonance_of_two_masses_is_found(joint):
    frequency = np.unique(np.round(np.geomspace(3.0, 160.0, 26)))
    rng = np.random.default_rng(9)
    exact = elastic.response_of(joint, frequency, PERIOD_S)
    noisy = exact * (1.0 + 0.005 * (rng.normal(size=len(exact)) + 1j * rng.normal(size=len(exact))))
    found = elastic.solve(frequency, noisy, np.full(len(frequency), 0.005), PERIOD_S, 0.6 * joint.inertia)
    assert found.resonance_hz == pytest.approx(joint.resonance_hz, rel=0.02)
    assert found.inertia == pytest.approx(joint.inertia, rel=0.03)
    assert found.load_share == pytest.approx(joint.load_share, rel=0.05)
    assert found.delay_s == pytest.approx(joint.delay_s, abs=1e-4)


@pytest.mark.parametrize("lag_s", [0.0, 3e-4])
def test_a_lag_beside_a_resonance_is_bounded_by_what_the_response_shows(lag_s):
    """The interval of the delay reaches down by that: of no lag by a third of a cycle at most, of a lag to below it."""
    frequency = np.unique(np.round(np.geomspace(3.0, 160.0, 26)))
    rng, joint = np.random.default_rng(9), Elastic(1e-3, 0.06, 1e-3, 90.0, 0.5, 0.03)
    exact = elastic.response_of(joint, frequency, PERIOD_S) / (1.0 + 2j * np.pi * frequency * lag_s)
    noisy = exact * (1.0 + 0.005 * (rng.normal(size=len(exact)) + 1j * rng.normal(size=len(exact))))
    seen = frequency, noisy, np.full(len(frequency), 0.005), PERIOD_S
    longest = elastic.longest_lag_s(elastic.solve(*seen, 6e-4), *seen, 1e-3, 1.1)
    assert lag_s <= longest < lag_s + 3.3e-4


def test_bristle_force_along_a_recorded_motion_is_that_of_the_plant():
    friction = {"kind": "lugre", "sigma0": 950.0, "sigma1": 1.0, "coulomb": 0.045, "static": 0.07}
    model = validate({"inertia": 1e-3, "delay_s": 0.0, "friction": friction}, AxisModel, "joint")
    plant, position, velocity, acceleration = Plant(model), [], [], []
    torque = 0.09 * np.sin(2.0 * np.pi * 3.0 * np.arange(700) * PERIOD_S)
    for u in torque:
        before = plant.velocity_rad_s
        plant.advance(float(u), PERIOD_S)
        position.append(plant.position_rad)
        velocity.append(plant.velocity_rad_s)
        acceleration.append((plant.velocity_rad_s - before) / PERIOD_S)
    v = np.array(velocity)
    steady = np.sign(v) * (0.045 + 0.025 * np.exp(-((v / 0.1) ** 2)))
    length, way = np.maximum(np.abs(steady), 0.01) / 950.0, np.abs(np.diff(position, prepend=0.0))
    force = dry_columns(steady[:, None], v, way, length, Bristle(950.0, 1.0, 0.07))[:, 0]
    measured = torque - 1e-3 * np.array(acceleration)
    settled = np.sign(v) * follow(np.sign(v)[:, None], way, length)[:, 0] > 0.95
    assert np.count_nonzero(settled) > 300
    assert np.sqrt(np.mean((force - measured)[settled] ** 2)) < 0.03 * 0.045


def test_a_bristle_settles_over_its_length():
    settled = follow(np.ones((100, 1)), np.full(100, 0.1), np.ones(100))[:, 0]
    turned = follow(np.concatenate([np.ones(50), -np.ones(50)])[:, None], np.full(100, 0.1), np.ones(100))[:, 0]
    assert settled == pytest.approx(1.0)
    assert turned[59] == pytest.approx(2.0 * np.exp(-1.0) - 1.0)


def test_cogging_seen_through_smoothing_is_given_back_whole():
    x = np.linspace(0.0, 1.0, 200)
    seen = cogging.columns(x, [40], 0.01)
    assert seen == pytest.approx(np.exp(-0.08) * cogging.columns(x, [40]))


def excited(disturbance_nm: list[float]) -> RecordedMotion:
    """Strokes of a rigid joint under a multisine, each with its disturbance (RMS below 40 Hz), without gaps."""
    joint, count, rng = Rigid(1e-3, 0.06, 0.0015, 0.0), 1000, np.random.default_rng(3)
    lines = np.unique(np.round(np.geomspace(3.0, 160.0, 26))).astype(int)
    wave = 0.02 * multisine(lines, lines / lines.max(), count, rng)
    frequency = np.fft.rfftfreq(count, PERIOD_S)
    ratio = np.concatenate([[0.0], response_of(joint, frequency[1:], PERIOD_S)])
    ways, torques = [], []
    for rms in disturbance_nm:
        noise = np.fft.rfft(rng.normal(size=count)) * ((frequency > 0.0) & (frequency < 40.0))
        noise *= rms / np.std(np.fft.irfft(noise))
        ways.append(np.fft.irfft(ratio * (np.fft.rfft(wave) + noise), count))
        torques.append(wave)
    position, torque = np.concatenate([[0.0], np.cumsum(ways)]), np.append(np.concatenate(torques), 0.0)
    settings = {"first": 0.0, "stride": float(count), "count": float(count), "strokes": float(len(ways))}
    settings |= {f"line_{i}": float(line) for i, line in enumerate(lines)}
    t = np.arange(len(torque)) * PERIOD_S
    return RecordedMotion(ExperimentKind.RESPONSE, t, torque, position, position, torque, torque, position, settings)


def noise_of(trace: RecordedMotion) -> Estimate:
    """Torque noise of a joint without cogging."""
    return response.torque_noise(trace, response.fit(trace, 1e-3), ())


def test_the_interval_of_the_torque_noise_is_the_scatter_of_the_strokes():
    steady = noise_of(excited([4e-4] * 12))
    assert steady.holds(4e-4)
    assert 0.03 < steady.half_width / steady.value < 0.15
    once = noise_of(excited([1e-5] * 11 + [1.4e-3]))
    assert once.half_width > 0.5 * once.value


@pytest.mark.parametrize("seed", range(3, 8))
@pytest.mark.parametrize("period_s", [0.004, 0.02])
def test_a_slow_cycle_tells_mass_and_torque_noise_up_to_its_excited_lines(period_s, seed):
    """A stroke of a second has 50 samples at 20 ms, and lines up to a quarter of that: none tells of a spring."""
    joint, count, rng = Rigid(1e-1, 0.6, 0.003, 0.0), round(1.0 / period_s), np.random.default_rng(seed)
    lines = np.arange(1, count // 4 + 1)
    wave = 0.02 * multisine(lines, lines / lines.max(), count, rng)
    frequency = np.fft.rfftfreq(count, period_s)
    ratio = np.concatenate([[0.0], response_of(joint, frequency[1:], period_s)])
    pushed = [np.fft.rfft(4e-4 * rng.normal(size=count)) for _ in range(12)]
    ways = np.concatenate([np.fft.irfft(ratio * (np.fft.rfft(wave) + noise), count) for noise in pushed])
    settings = {"first": 0.0, "stride": float(count), "count": float(count), "strokes": 12.0}
    settings |= {f"line_{i}": float(line) for i, line in enumerate(lines)}
    torque, position = np.append(np.tile(wave, 12), 0.0), np.concatenate([[0.0], np.cumsum(ways)])
    t = np.arange(len(torque)) * period_s
    trace = RecordedMotion(ExperimentKind.RESPONSE, t, torque, position, position, torque, torque, position, settings)
    fitted = response.fit(trace, 0.1)
    assert fitted.resonance is None
    assert fitted.inertia.value == pytest.approx(0.1, rel=0.01)
    told = response.torque_noise(trace, fitted, ())
    assert told.value == pytest.approx(4e-4 * np.sqrt(min(40.0, lines[-1]) * 2.0 * period_s), rel=0.25)


def test_cogging_that_is_known_is_no_torque_noise():
    """The plant's own simulation under the same multisine; the joint slides over 26 teeth of 20 mN*m."""
    joint = AxisModel.model_validate(
        {
            "inertia": 1e-3,
            "delay_s": 1e-3,
            "friction": {"kind": "coulomb_viscous", "viscous": 0.06},
            "cogging": {"harmonics": [{"amplitude": 0.02, "periods_per_turn": 22, "phase": 0.7}]},
        }
    )
    slid = excited([0.0] * 8)
    plant, pushed, position = Plant(joint), slid.torque_nm + 0.06, []
    for torque in pushed:
        position.append(plant.position_rad)
        plant.advance(float(torque), PERIOD_S)
    slid.settings["first"], slid.settings["strokes"] = slid.settings["count"], 7.0
    slid = replace(slid, torque_nm=pushed, position_rad=np.array(position))
    wave = FittedHarmonic(22, Estimate(0.02, 0.02, 0.02, "N*m"), 0.7)
    answer = response.fit(slid, 1e-3)
    assert response.torque_noise(slid, answer, ()).value > 0.005
    assert response.torque_noise(slid, answer, (wave,)).value < 0.001


def test_the_intervals_of_the_curve_are_the_scatter_of_its_nodes():
    speed = np.geomspace(5e-3, 1.0, 25)
    truth = np.array([0.05, 0.03, np.log(0.1), 1.4, 0.05])
    known = np.array([0.05, np.nan, 0.1, 1.4, 0.05])  # static friction has an allowance of its own
    exact, rng, deviation = curve.friction(truth, speed), np.random.default_rng(12), 2e-4
    found = []
    for _ in range(30):
        torque = exact + deviation * rng.normal(size=len(speed))
        half, covariance = np.full(len(speed), 1.96 * deviation), deviation**2 * np.eye(len(speed))
        found.append(curve.fit(Side(speed, torque, half, covariance)))
    values = np.array([[number.value for number in each] for each in found])
    halves = np.array([[number.half_width for number in each] for each in found])
    told = np.isfinite(known)
    ratio = np.median(halves, axis=0)[told] / (2.09 * np.std(values, axis=0)[told])
    assert np.all((ratio > 0.65) & (ratio < 1.5))
    assert np.all(np.mean(np.abs(values - known) <= halves, axis=0)[told] >= 0.85)


def bursts(counts_per_turn: int, rng: np.random.Generator) -> list[RecordedMotion]:
    """Presliding of a joint of 950 N*m/rad at the share for coarse encoders, each burst anywhere within a count."""
    friction = {"kind": "lugre", "sigma0": 950.0, "sigma1": 1.0, "coulomb": 0.045, "static": 0.07}
    plant = Plant(validate({"inertia": 1e-3, "delay_s": 0.0, "friction": friction}, AxisModel, "joint"))
    t, way = np.arange(1000) * PERIOD_S, []
    torque = 0.62 * 0.07 * np.sin(2.0 * np.pi * 8.0 * t)
    for u in torque:
        way.append(plant.position_rad)
        plant.advance(float(u), PERIOD_S)
    resolution_rad = 2.0 * np.pi / counts_per_turn
    settings = {"frequency_hz": 8.0, "from_s": 0.25, "cycles": 5.0, "share": 0.62, "resolution_rad": resolution_rad}
    made = []
    for place in rng.uniform(0.0, resolution_rad, 11):
        x = np.round((np.array(way) + place) / resolution_rad) * resolution_rad
        made.append(RecordedMotion(ExperimentKind.PRESLIDING, t, torque, x, x, torque, torque, x, settings))
    return made


SLIDES = BreakAwayFit(Estimate(0.07, 0.068, 0.072, "N*m"), Estimate(0.07, 0.068, 0.072, "N*m"))


@pytest.mark.parametrize("bits", [16, 17, 20])
def test_stiffness_by_an_encoder_that_shows_a_count_or_more(bits):
    found = presliding.fit(bursts(2**bits, np.random.default_rng(bits)), SLIDES).stiffness
    assert found.holds(950.0)
    assert found.half_width < 0.2 * found.value


@pytest.mark.parametrize("counts", [16_384, 10_000, 1_000])
def test_stiffness_by_an_encoder_that_is_too_coarse_is_said_not_to_be_identifiable(counts):
    for seed in range(6):
        with pytest.raises(AnswerIsNo, match=r"not identifiable with this encoder: .* counts of .* or more"):
            presliding.fit(bursts(counts, np.random.default_rng(seed)), SLIDES)


@pytest.mark.parametrize("counts", [0.05, 0.2, 0.33, 0.5, 1.0, 5.0])
def test_the_interval_of_the_encoder_noise_holds_it_beside_the_rounding(counts):
    rng, resolution_rad, held, widths = np.random.default_rng(13), 2.0 * np.pi / 2**20, [], []
    for _ in range(100):
        readings = np.round(rng.uniform(-0.5, 0.5) + counts * rng.normal(size=1500))  # anywhere within a count
        torque, zeros = rng.normal(0.0, 1e-3, 1500), np.zeros(1500)
        x = readings * resolution_rad
        settings = {"resolution_rad": resolution_rad}
        found = analysis.fit(
            RecordedMotion(ExperimentKind.NOISE, np.arange(1500) * PERIOD_S, zeros, x, x, zeros, torque, x, settings)
        )
        held.append((found.encoder_rms.holds(counts * resolution_rad), found.torque_reading_rms.holds(1e-3)))
        widths.append(found.encoder_rms.half_width / resolution_rad)
    assert np.all(np.mean(held, axis=0) >= 0.88)
    assert np.median(widths) < max(0.25, 0.07 * counts)


def test_what_stands_at_the_end_of_its_range_says_so():
    assert bound_notes([0.0, 0.5, 1.0], [0.0] * 3, [1.0] * 3) == (AT_END, "", AT_END)
    speed = np.geomspace(5e-3, 1.0, 25)
    flat = curve.fit(Side(speed, 0.05 + 0.05 * speed, np.full(25, 1e-4), 1e-9 * np.eye(25)))
    assert AT_END in flat.static.note and not flat.coulomb.note
    strange = response.fit(excited([1e-4] * 4), 1e-3 * np.exp(4.0))
    assert AT_END in strange.inertia.note
    joint = Elastic(1e-3, 0.05, 0.0015, 60.0, 0.3, 1e-3)
    assert elastic.notes(joint, 1e-3, 160.0) == ("", "", "", "", "", AT_END)


def rung(lines, torque, way) -> RecordedMotion:
    """Five periods of a second each, on the bristles."""
    settings = {"count": len(torque) / 5.0, "periods": 5.0}
    settings |= {f"line_{i}": float(line) for i, line in enumerate(lines)}
    t = np.arange(len(torque)) * PERIOD_S
    return RecordedMotion(ExperimentKind.BRISTLE, t, torque, way, way, torque, torque, way, settings)


def test_bristle_damping_is_told_from_the_spring_that_a_part_of_the_inertia_is_behind():
    """Two masses on a bristle, stepped exactly; taken for one rigid mass its damping comes out elsewhere."""
    spring = Elastic(1e-3, 0.06, 0.0, 150.0, 0.5, 0.02)
    motor, load, k, d = 5e-4, spring.load_inertia, spring.stiffness, spring.damping
    a, stiffness, damping = np.zeros((5, 5)), 950.0, 1.0
    a[0, 1] = a[2, 3] = 1.0
    a[1] = np.array([-k - stiffness, -d - damping, k, d, 1.0]) / motor
    a[3] = np.array([k, d, -k, -d, 0.0]) / load
    step, lines, rng = expm(a * PERIOD_S), np.arange(25, 230, 17), np.random.default_rng(4)
    torque, state, way = np.tile(0.01 * multisine(lines, np.ones(len(lines)), 1000, rng), 5), np.zeros(5), []
    for u in torque:
        way.append(state[0])
        state[4] = u
        state = step @ state
    ringing = rung(lines, torque, np.array(way) + 1e-9 * rng.normal(size=len(way)))
    told = bristle.fit(ringing, Moved(1e-3, spring), 0.0, 0.0, stiffness)
    rigid = bristle.fit(ringing, Moved(1e-3), 0.0, 0.0, stiffness)
    assert told is not None
    assert told.value == pytest.approx(damping, rel=0.05)
    assert rigid is None or abs(rigid.value - damping) > 0.3


@pytest.mark.parametrize(("damping", "noted"), [(0.6, False), (20.0, True)])
def test_bristle_damping_beyond_its_range_says_so(damping, noted):
    inertia, stiffness, count = 1e-3, 950.0, 1000
    lines, rng = np.arange(25, 230, 17), np.random.default_rng(4)
    critical = 2.0 * np.sqrt(stiffness * inertia)
    wave = 0.01 * multisine(lines, np.ones(len(lines)), count, rng)
    ratio = np.zeros(count // 2 + 1, dtype=complex)
    moved = Moved(inertia)
    ratio[lines] = bristle.response(lines / 1.0, moved, stiffness, 0.1, damping * critical, 1e-3, PERIOD_S)
    way = np.tile(np.fft.irfft(ratio * np.fft.rfft(wave), count), 5) + 1e-9 * rng.normal(size=5 * count)
    found = bristle.fit(rung(lines, np.tile(wave, 5), way), moved, 1e-3, 0.0, 950.0)
    assert found is not None
    assert (AT_END in found.note) == noted


@pytest.mark.parametrize("top_rad_s", [0.02, 0.3, 30.0])
def test_a_stribeck_curve_is_found_whatever_its_range_of_speed(top_rad_s):
    speed = np.geomspace(1e-2, 1.0, 25) * top_rad_s
    truth = np.array([0.05, 0.03, np.log(0.15 * top_rad_s), 1.4, 0.01 / top_rad_s])
    torque = curve.friction(truth, speed)
    side = Side(speed, torque, 1e-3 * torque, np.diag((1e-4 * torque) ** 2))
    found = curve.fit(side)
    assert found.coulomb.value == pytest.approx(0.05, rel=1e-3)
    assert found.static.value == pytest.approx(0.08, rel=1e-3)
    assert found.stribeck_velocity.value == pytest.approx(0.15 * top_rad_s, rel=1e-3)
