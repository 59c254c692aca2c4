"""Gain sets: every mistake gives its one line, good ones survive the round trip, certificates bind to the numbers."""

from __future__ import annotations

import asyncio
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import yaml

from servod.cli.gains import warn
from servod.common.errors import BadInput
from servod.common.shipped import shipped
from servod.common.sources import VERIFIES, source_sha256
from servod.formats.config import AxisConfig, load_config
from servod.formats.gains.gain_set import GainSet, load_gains, parse_gains, require_certificate, require_fit
from servod.formats.gains.parameters import LocalParameters, PdParameters
from servod.formats.gains.store import GainStore
from servod.formats.model.axis_model import axis_model_yaml
from servod.kernels.laws import LAWS, local
from servod.runtime.daemon.gain_bank import GainBank
from tests.formats.gains import good
from tests.formats.gains.good import DESIGN

BAD = yaml.safe_load(Path(__file__).with_name("bad_gains.yaml").read_text(encoding="utf-8"))
SEALED_BEFORE_REST = Path(__file__).with_name("sealed_before_rest.yaml")
SHIPPED = sorted((Path(__file__).resolve().parents[3] / "gains").glob("*.yaml"))


@pytest.mark.parametrize("case", BAD, ids=lambda case: case["why"])
def test_a_mistake_gives_one_exact_line(case: dict[str, str]) -> None:
    text = getattr(good, case["text"])
    old, new = case["replace"]
    assert text.count(old) >= 1
    with pytest.raises(BadInput) as caught:
        parse_gains(text.replace(old, new, 1), "bad.yaml")
    assert str(caught.value) == case["error"]


def test_missing_file_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "none.yaml"
    with pytest.raises(BadInput, match=f"{path}: there is no such file$"):
        load_gains(path)


@pytest.mark.parametrize("text", [good.PD, good.LUGRE, good.LOCAL], ids=["pd", "pd_lugre", "local"])
def test_round_trip(text: str) -> None:
    gains = parse_gains(text, "good.yaml")
    again = parse_gains(gains.to_yaml(), "again.yaml")
    assert again == gains
    assert again.parameters_sha256() == gains.parameters_sha256()


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_every_shipped_set_is_good_and_named_as_its_file(path: Path) -> None:
    gains = load_gains(path)
    assert gains.name == path.stem
    assert gains.law.accepts(gains.pack())
    assert gains.provenance.note


def test_the_paper_and_the_demo_ship() -> None:
    names = {path.stem for path in SHIPPED}
    assert {"table1_kz_kv_kx", "table1_kx_kv_kz", "paper_pd", "paper_pd_dob", "paper_pd_lugre"} <= names
    assert {f"demo_{law}" for law in LAWS} <= names


@pytest.mark.parametrize("name", ["1e5", "0x1f", "true", "on", "2026-11-20", "no"])
def test_names_that_look_like_something_else_survive_the_round_trip(name: str) -> None:
    gains = parse_gains(good.PD.replace("name: bench_pd", f"name: '{name}'"), "good.yaml")
    assert parse_gains(gains.to_yaml(), "again.yaml").name == name


def test_numbers_are_those_of_yaml_1_2() -> None:
    assert parse_gains(good.PD, "good.yaml").pack() == (2.5, 0.12, 0.0)


def test_pack_of_the_local_law_is_what_the_kernel_reads() -> None:
    text = good.LOCAL.replace(
        "    sets:", "    velocity: reference\n    lead_s: 0.002\n    weights: gaussian\n    sets:"
    )
    flat = parse_gains(text, "good.yaml").pack()
    p = local.LocalGains.from_flat(flat)
    assert p.flat() == flat
    assert p.input_scale == 0.1
    assert flat[1:7] == (p.low_k_z, p.low_k_x, p.low_k_v, p.high_k_z, p.high_k_x, p.high_k_v)
    assert flat[1:7] == (0.0, 1574.9, 0.241, 0.0, 197.0, 2.104)
    assert (p.blend_from, p.blend_to) == (0.005, 0.02)
    assert (p.stiffness, p.viscous, p.leak) == (760.0, 0.056, 2.0)
    assert p.state_limit == 0.12 / 760.0
    assert (p.source, p.lead, p.shape) == (local.REFERENCE, 0.002, 2.0)
    assert (p.hold_within, p.feedforward_inertia, p.observer_bandwidth) == (0.0, 0.0, 0.0)
    assert flat[local.N_SETS :] == (3.0, -0.5, 0.0, 0.5, 8000.0, 0.0, 7000.0, 0.04, 0.0, 0.0)


def test_hash_sees_numbers_not_spelling() -> None:
    gains = parse_gains(good.PD, "good.yaml")
    spelled = good.PD.replace("12e-2", "0.12").replace("for tests", "other words").replace("name: bench_pd", "name: b")
    changed = good.PD.replace("12e-2", "0.1200001")
    assert parse_gains(spelled, "x.yaml").parameters_sha256() == gains.parameters_sha256()
    assert parse_gains(changed, "x.yaml").parameters_sha256() != gains.parameters_sha256()
    whole = good.LOCAL.replace("k_x_per_rad: 197,", "k_x_per_rad: 197.0,")
    local_hash = parse_gains(good.LOCAL, "x.yaml").parameters_sha256()
    assert parse_gains(whole, "x.yaml").parameters_sha256() == local_hash


def test_a_certificate_counts_until_a_number_changes() -> None:
    gains = good.certified(parse_gains(good.PD, "good.yaml"))
    require_certificate(gains, accept_uncertified=False)
    changed = gains.to_yaml().replace("position_gain_nm_per_rad: 2.5", "position_gain_nm_per_rad: 2.6")
    tampered = parse_gains(changed, "t").sealed()
    for accept_uncertified in (False, True):
        with pytest.raises(BadInput, match="they were changed after it was issued"):
            require_certificate(tampered, accept_uncertified)


@pytest.mark.parametrize("gone", [{"seal": None, "design": None}, {"design": None}, {"seal": None}], ids=str)
def test_a_certificate_does_not_count_without_its_design_and_seal(gone: dict[str, None]) -> None:
    gains = good.certified(parse_gains(good.PD, "good.yaml")).model_copy(update=gone)
    for found in (gains, gains.sealed()) if "design" in gone else (gains,):
        with pytest.raises(BadInput, match=r"sealed|no seal|without the design that it is of and its seal"):
            require_certificate(found, accept_uncertified=True)


def test_a_certificate_of_another_model_does_not_count() -> None:
    gains = good.certified(parse_gains(good.PD, "good.yaml"))
    assert gains.certificate is not None
    other = gains.certificate.model_copy(update={"model_sha256": "ab" * 32})
    with pytest.raises(BadInput, match="for another axis model"):
        require_certificate(gains.model_copy(update={"certificate": other}).sealed(), accept_uncertified=True)


def test_a_set_without_a_certificate_passes_only_where_the_configuration_accepts_it() -> None:
    gains = parse_gains(good.PD, "x")
    require_certificate(gains, accept_uncertified=True)
    with pytest.raises(BadInput) as caught:
        require_certificate(gains, accept_uncertified=False)
    assert str(caught.value) == (
        "gain set bench_pd: certificate: found no certificate; allowed: a valid one (`servoctl verify` issues it), "
        "or gains.accept_uncertified: true in the configuration"
    )


@pytest.mark.parametrize("accept_uncertified", [False, True])
@pytest.mark.parametrize(
    ("gains", "problem"),
    [
        (
            good.certified(parse_gains(good.PD, "x"), valid=False),
            "certificate: found a certificate that says valid: false; "
            "allowed: a valid one (`servoctl verify` issues it)",
        ),
        (
            parse_gains(good.PD, "x").model_copy(update={"seal": "0" * 64}),
            "seal: found numbers that were changed after the set was sealed, or a certificate that was taken out; "
            "allowed: the file as servoctl wrote it; for other numbers make the set again "
            "(`servoctl synthesize`, then `verify`)",
        ),
    ],
)
def test_a_certificate_that_says_no_and_a_broken_seal_are_refused_always(
    gains: GainSet, problem: str, accept_uncertified: bool
) -> None:
    with pytest.raises(BadInput) as caught:
        require_certificate(gains, accept_uncertified)
    assert str(caught.value) == f"gain set bench_pd: {problem}"


def test_an_optional_key_of_a_later_version_leaves_certificate_and_seal_as_they_are() -> None:
    class LaterParameters(PdParameters):
        later: float | None = None

    class LaterSet(GainSet):
        later: float | None = None

    gains = good.certified(parse_gains(good.PD, "good.yaml")).sealed()
    content = {key: getattr(gains, key) for key in GainSet.model_fields}
    parameters = LaterParameters(**gains.parameters.model_dump())
    later = LaterSet.model_construct(**content | {"parameters": parameters})
    assert later.certificate_problem() is None
    used = LaterSet.model_construct(**content | {"parameters": parameters, "later": 1.0})
    assert used.seal_broken


def test_a_set_designed_for_another_filter_or_cycle_does_not_fit_the_axis() -> None:
    config = load_config(shipped("gains/config/virtual.yaml"))
    assert config.gains.accept_uncertified  # which does not make another loop the same one
    strict = config.model_copy(update={"gains": config.gains.model_copy(update={"accept_uncertified": False})})
    certified = good.certified(parse_gains(good.PD, "good.yaml"))

    def designed(period_s: float, cutoff_hz: float) -> GainSet:
        design = DESIGN.model_copy(update={"period_s": period_s, "velocity_cutoff_hz": cutoff_hz})
        return certified.model_copy(update={"design": design}).sealed()

    cutoff_hz = config.encoder.velocity_cutoff_hz
    for axis in (strict, config):
        require_fit(designed(0.001, cutoff_hz), axis)
        with pytest.raises(BadInput, match=r"design\.velocity_cutoff_hz: found 500\.0"):
            require_fit(designed(0.001, 500.0), axis)
        with pytest.raises(BadInput, match=r"design\.period_s: found 0\.002"):
            require_fit(designed(0.002, cutoff_hz), axis)


def test_the_daemon_refuses_a_changed_set_although_it_accepts_sets_without_a_certificate(tmp_path: Path) -> None:
    file = tmp_path / "bench_pd.yaml"
    file.write_text(good.certified(parse_gains(good.PD, "good.yaml")).sealed().to_yaml())
    config = load_config(shipped("gains/config/virtual.yaml"))
    gains = config.gains.model_copy(update={"directory": tmp_path / "store", "initial": file})
    assert gains.accept_uncertified
    axis = config.model_copy(update={"gains": gains})
    assert GainBank(axis).newest.name == "bench_pd"
    file.write_text(file.read_text().replace("position_gain_nm_per_rad: 2.5", "position_gain_nm_per_rad: 2.6"))
    elsewhere = gains.model_copy(update={"directory": tmp_path / "new"})
    with pytest.raises(BadInput, match="changed after the set was sealed"):
        GainBank(config.model_copy(update={"gains": elsewhere}))


def test_a_daemon_starts_with_the_initial_set_when_the_active_one_is_for_another_filter(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    config = load_config(shipped("gains/config/virtual.yaml"))
    plain = parse_gains(good.PD, "good.yaml")
    file = tmp_path / "bench_pd.yaml"
    file.write_text(plain.to_yaml())
    design = DESIGN.model_copy(update={"velocity_cutoff_hz": config.encoder.velocity_cutoff_hz})
    wanted = good.certified(plain.model_copy(update={"name": "designed", "design": design}).sealed())
    gains = config.gains.model_copy(update={"directory": tmp_path / "store", "initial": file})
    axis = config.model_copy(update={"gains": gains})
    store = GainStore(gains.directory)
    store.load(wanted.sealed().to_yaml(), "designed")
    store.activate("designed")
    assert GainBank(axis).newest.name == "designed"
    encoder = config.encoder.model_copy(update={"velocity_cutoff_hz": 500.0})
    assert GainBank(axis.model_copy(update={"encoder": encoder})).newest.name == "bench_pd"
    assert "design.velocity_cutoff_hz" in caplog.text and "servoctl gains activate designed" in caplog.text
    active, last = store.active(), store.history()[-1]
    assert active is not None and active.name == "bench_pd" and "in place of designed" in last.note


def test_a_set_that_an_earlier_version_sealed_is_what_it_was() -> None:
    """No key of a later version writes itself into it: seal and certificate hold, and so do the numbers."""
    text = SEALED_BEFORE_REST.read_text(encoding="utf-8")
    gains = parse_gains(text, "earlier")
    assert gains.certificate_problem() is None
    assert gains.to_yaml() == text
    p = local.LocalGains.from_flat(gains.pack())
    assert (p.rest_within, p.rest_share) == (0.0, 1.0)
    require_fit(gains, load_config(shipped("gains/config/virtual.yaml")))


@pytest.mark.parametrize(
    ("velocity", "source"),
    [("measured", local.MEASURED), ("reference", local.REFERENCE), ("corrected_reference", local.CORRECTED)],
)
def test_every_velocity_source_has_its_own_number(velocity: str, source: float) -> None:
    text = good.LOCAL.replace("    sets:", f"    velocity: {velocity}\n    sets:")
    assert local.LocalGains.from_flat(parse_gains(text, "good.yaml").pack()).source == source


@pytest.mark.parametrize(("low", "moving", "packed"), [(None, None, 50.0), (300.0, None, 300.0), (300.0, 120.0, 120.0)])
def test_an_observer_of_an_earlier_version_keeps_its_bandwidth_in_slow_motion(
    low: float | None, moving: float | None, packed: float
) -> None:
    parameters = parse_gains(SEALED_BEFORE_REST.read_text(encoding="utf-8"), "earlier").parameters
    assert isinstance(parameters, LocalParameters) and parameters.disturbance_observer is not None
    bandwidths = {"low_bandwidth_rad_s": low, "low_moving_bandwidth_rad_s": moving}
    observer = parameters.disturbance_observer.model_copy(update=bandwidths)
    p = parameters.model_copy(update={"disturbance_observer": observer}).named()
    assert (p.observer_bandwidth, p.observer_moving) == (50.0, packed)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("bandwidth_rad_s: 50.0", "bandwidth_rad_s: 51.0"), "changed after the set was sealed"),
        (("hold_within_rad:", "hold_within_turns:"), "hold_within_turns"),
    ],
    ids=["a broken seal", "a key that is not known"],
)
def test_a_daemon_starts_with_the_initial_set_whatever_is_wrong_with_the_active_one(
    change: tuple[str, str], said: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    config = load_config(shipped("gains/config/virtual.yaml"))
    axis = config.model_copy(update={"gains": config.gains.model_copy(update={"directory": tmp_path})})
    store = GainStore(tmp_path)
    stored = store.load_file(SEALED_BEFORE_REST)
    store.activate(stored.name)
    assert GainBank(axis).newest.name == "sealed_before_rest"
    stored.path.write_text(stored.path.read_text().replace(*change))
    assert GainBank(axis).newest.name == "demo_pd"
    assert said in caplog.text and "runs in place of sealed_before_rest version 1" in caplog.text
    active, last = store.active(), store.history()[-1]
    assert active is not None and active.name == "demo_pd" and said in last.note


def test_a_set_for_a_finer_encoder_more_torque_or_less_delay_does_not_fit_the_axis(tmp_path: Path) -> None:
    config = load_config(shipped("gains/config/virtual.yaml"))
    designed = good.certified(parse_gains(good.PD, "good.yaml").model_copy(update={"design": DESIGN}).sealed())
    assert designed.certificate is not None

    def certified_with(torque_nm: float | None) -> GainSet:
        assert designed.certificate is not None
        certificate = designed.certificate.model_copy(update={"torque_nm": torque_nm})
        return designed.model_copy(update={"certificate": certificate}).sealed()

    def with_encoder(counts: int) -> AxisConfig:
        return config.model_copy(update={"encoder": config.encoder.model_copy(update={"counts_per_turn": counts})})

    def with_model(delay_s: float) -> AxisConfig:
        path = tmp_path / f"{delay_s}.yaml"
        path.write_text(axis_model_yaml(DESIGN.model.model_copy(update={"delay_s": delay_s})))
        return config.model_copy(update={"model": path})

    for torque_nm in (None, config.limits.torque_nm):
        for axis in (config, with_encoder(2**23), with_model(0.00105), with_model(0.0005)):
            require_fit(certified_with(torque_nm), axis)
    with pytest.raises(BadInput, match=r"design\.counts_per_turn: found 1048576\.0; allowed: at most 131072"):
        require_fit(certified_with(None), with_encoder(2**17))
    with pytest.raises(BadInput, match=r"certificate\.torque_nm: found 0\.4; allowed: at most 0\.3"):
        require_fit(certified_with(0.4), config)
    with pytest.raises(BadInput, match=r"design\.model\.delay_s: found 0\.001; allowed: 0\.002"):
        require_fit(certified_with(None), with_model(0.002))


def test_a_certificate_of_other_checks_is_told_and_no_reason_to_refuse(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    config = load_config(shipped("gains/config/virtual.yaml"))
    plain = good.certified(parse_gains(good.PD, "good.yaml"))
    assert plain.certificate is not None
    file = tmp_path / "bench_pd.yaml"
    gains = config.gains.model_copy(update={"directory": tmp_path / "store", "initial": file})
    for tool, told in ((None, False), (source_sha256(VERIFIES), False), ("ab" * 32, True)):
        certificate = plain.certificate.model_copy(update={"tool_sha256": tool})
        file.write_text(plain.model_copy(update={"certificate": certificate}).sealed().to_yaml())
        assert GainStore(gains.directory).load_file(file).gains.certificate_problem() is None
        GainStore(gains.directory).activate("bench_pd")
        bank = GainBank(config.model_copy(update={"gains": gains}))
        with ThreadPoolExecutor(1) as slow:
            listed = asyncio.run(bank.list(0, slow))
        warn(listed["gains"][-1:])
        assert ("another version of the checks" in caplog.text) is told
        assert ("warning: bench_pd version" in capsys.readouterr().err) is told
