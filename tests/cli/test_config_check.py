"""`servoctl config check` on everything that ships, and its JSON."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

import servod.drivers
from servod.cli.app import run
from servod.common.shipped import shipped
from servod.common.yaml import parse_yaml
from servod.formats.config import load_config
from servod.formats.gains.gain_set import GainSet, parse_gains
from tests.formats.gains import good

GAINS = shipped("gains")
EDS = Path(servod.drivers.__file__).parent / "eds"
SHIPPED = sorted([*GAINS.glob("*.yaml"), *GAINS.glob("axes/*.yaml"), *GAINS.glob("config/*.yaml"), *EDS.glob("*.eds")])


@pytest.mark.parametrize("file", SHIPPED, ids=lambda f: f.name)
def test_what_ships_has_no_mistakes(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code = run(["config", "check", str(file), "--json"])
    captured = capsys.readouterr()
    assert code == 0, captured.err
    (row,) = json.loads(captured.out)["files"]
    assert row["kind"] == {"axes": "axis model", "config": "axis configuration", "eds": "EDS"}.get(
        file.parent.name, "gain set"
    )


def test_every_relative_path_is_relative_to_the_file(tmp_path: Path) -> None:
    limits = load_config(GAINS / "config" / "virtual.yaml").limits.model_dump()
    paths = {
        "bus": {"interface": "virtual", "channel": "run/bus"},
        "amplifier": {"eds": "a.eds"},
        "encoder": {"eds": "e.eds"},
        "gains": {"directory": "gains", "initial": "../pd.yaml"},
        "control": {"socket": "run/axis.sock"},
        "recorder": {"directory": "/var/recordings"},
        "metrics": {"textfile": "m.prom"},
    }
    file = tmp_path / "axis.yaml"
    file.write_text(json.dumps({"limits": limits, "model": "model.yaml", **paths}))
    config = load_config(file)
    assert (config.bus.channel, config.amplifier.eds) == (str(tmp_path / "run/bus"), str(tmp_path / "a.eds"))
    assert (config.encoder.eds, config.model) == (str(tmp_path / "e.eds"), tmp_path / "model.yaml")
    assert (config.gains.directory, config.gains.initial) == (tmp_path / "gains", tmp_path / "../pd.yaml")
    assert (config.control.socket, config.metrics.textfile) == (tmp_path / "run/axis.sock", tmp_path / "m.prom")
    assert config.recorder.directory == Path("/var/recordings")


def test_the_channel_of_a_real_bus_is_no_path(tmp_path: Path) -> None:
    file = tmp_path / "axis.yaml"
    file.write_text((GAINS / "config" / "can0.yaml").read_text())
    assert load_config(file).bus.channel == "can0"


def test_several_files_are_checked_in_order_and_each_mistake_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bad, none = tmp_path / "bad.yaml", tmp_path / "none.yaml"
    bad.write_text("inertia: -1\n")
    words = ["config", "check", str(bad), str(SHIPPED[0]), str(none)]
    assert run(words) == 2
    shown = capsys.readouterr()
    assert shown.out.startswith(f"{SHIPPED[0]}: axis model, no mistakes")
    first, second = shown.err.splitlines()
    assert first.startswith(f"servoctl: {bad}: inertia") and second == f"servoctl: {none}: there is no such file"
    assert run([*words, "--json"]) == 2
    shown = capsys.readouterr()
    rows = json.loads(shown.out)["files"]
    told = [row["error"] and f"servoctl: {row['error']['message']}" for row in rows]
    assert told == [first, None, second] and shown.err.splitlines() == [first, second]
    assert [row["kind"] for row in rows] == [None, "axis model", None]


def _changed(gains: GainSet, **update: Any) -> GainSet:
    return gains.model_copy(update=update)


CERTIFIED = good.certified(parse_gains(good.PD, "good"))
OTHER = _changed(parse_gains(good.PD, "good").parameters, velocity_gain_nms_per_rad=0.2)
ANOTHER_HASH = _changed(CERTIFIED.certificate, parameters_sha256="0" * 64)


@pytest.mark.parametrize(
    ("gains", "key", "found"),
    [
        (_changed(CERTIFIED, parameters=OTHER), "seal", "numbers that were changed after the set was sealed"),
        (_changed(CERTIFIED, seal="0" * 64), "seal", "numbers that were changed after the set was sealed"),
        (_changed(CERTIFIED, certificate=None), "seal", "or a certificate that was taken out"),
        (_changed(CERTIFIED, seal=None), "seal", "no seal, although the set has a design"),
        (_changed(CERTIFIED, certificate=ANOTHER_HASH).sealed(), "certificate.parameters_sha256", "other parameters"),
    ],
    ids=["a number", "the seal", "no certificate", "no seal", "the hash"],
)
def test_a_set_that_was_tampered_with_is_a_mistake(
    gains: GainSet, key: str, found: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "gains.yaml"
    file.write_text(gains.to_yaml())
    assert run(["config", "check", str(file)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{file}: {key}: found" in line and found in line and "verify`" in line


def test_a_set_without_a_certificate_is_allowed_and_noted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "gains.yaml"
    file.write_text(good.PD)
    assert run(["config", "check", str(file)]) == 0
    assert "law pd, not certified: no certificate" in capsys.readouterr().out


#: Each changes one value of the can0.yaml that ships, and the key that the warning begins with.
WEAK: list[tuple[dict[str, Any], str]] = [
    ({"limits": {"speed_rad_s": 1e5}}, "limits.speed_rad_s 100000: no joint"),
    ({"limits": {"speed_rad_s": 1.0}, "encoder": {"counts_per_turn": 4096}}, "limits.speed_rad_s 1: one count"),
    ({"limits": {"position_min_rad": -1e5, "position_max_rad": 1e5}}, "limits.position_min_rad and position_max_rad"),
    ({"limits": {"following_error_rad": 1e5}}, "limits.following_error_rad 100000"),
    ({"limits": {"encoder_mismatch_rad": 1e5}}, "limits.encoder_mismatch_rad 100000"),
    ({"limits": {"torque_rate_nm_per_s": 1e5}}, "limits.torque_rate_nm_per_s 100000"),
    (
        {"limits": {"stale_cycles": 200}, "stopping": {"within_s": 0.3}},
        "limits.stale_cycles 200: up to 0.2 s without feedback",
    ),
    ({"limits": {"torque_mismatch_nm": 0.3}}, "limits.torque_mismatch_nm 0.3: torque that the drive does not give"),
    ({"limits": {"oscillation_nm": 1e5}}, "limits.oscillation_nm 100000: a feedback loop that swings"),
    ({"wiring_proof": {"inertia": 1e-7}}, "limits.torque_nm 0.3: 2.73e+06 rad/s^2 of this joint"),
    ({"amplifier": {"unguarded": True}}, "amplifier.unguarded is true"),
    ({"amplifier": {"quick_stop_option": 0}}, "amplifier.quick_stop_option 0: at a quick stop"),
    ({"amplifier": {"heartbeat_reaction": 2}}, "amplifier.heartbeat_reaction 2: when servod dies"),
    ({"amplifier": {"guard_test_days": None}}, "amplifier.guard_test_days is not stated"),
    ({"stopping": {"within_s": 5.0}}, "stopping.within_s 5: torque may act for so long"),
    (
        {"heartbeat": {"command_deadline_ms": 2000, "drive_timeout_ms": 500}},
        "heartbeat.command_deadline_ms 2000: so long the drive goes on",
    ),
    ({"limits": {"late_cycles": 10_000}}, "limits.late_cycles 10000"),
    ({"limits": {"ramp_down_s": 1.0}}, "limits.ramp_down_s 1"),
    ({"heartbeat": {"drive_timeout_ms": 5000}}, "heartbeat.drive_timeout_ms 5000"),
    (
        {"heartbeat": {"command_deadline_ms": 0}},
        "heartbeat.command_deadline_ms 0: when the commands alone are lost the drive holds its torque",
    ),
    ({"wiring_proof": {"enabled": False}}, "wiring_proof.enabled is false"),
    ({"recorder": {"history_s": 0}}, "recorder.history_s is 0"),
    ({"limits": {"torque_nm": 9.0}, "amplifier": {"rated_torque_mnm": 100}}, "limits.torque_nm 9: 90 times"),
]


def _warned(file: Path, capsys: pytest.CaptureFixture[str]) -> list[str]:
    assert run(["config", "check", str(file), "--json"]) == 0
    (row,) = json.loads(capsys.readouterr().out)["files"]
    *others, uncertified = sorted(row["warnings"], key=lambda line: line.startswith("gains.accept_uncertified is true"))
    assert uncertified.startswith("gains.accept_uncertified is true")
    return others


def _sound(tmp_path: Path, over: dict[str, Any], model: dict[str, Any] | None = None) -> Path:
    """An axis about which there is nothing to warn but its gain set without a certificate, and `over`."""
    axis = parse_yaml((GAINS / "config" / "can0.yaml").read_text(), "can0")
    axis["gains"] |= {"initial": str(GAINS / "demo_pd.yaml"), "accept_uncertified": True}
    axis["wiring_proof"] = {"friction_nm": 0.05, "inertia": 0.001}
    axis["amplifier"]["guard_test_days"] = 180
    sound = {"torque_nm": 0.3, "torque_rate_nm_per_s": 100.0, "speed_rad_s": 5.0, "following_error_rad": 0.2}
    axis["limits"] |= {**sound, "position_min_rad": -1.0, "position_max_rad": 1.0, "encoder_mismatch_rad": 0.05}
    for name, section in over.items():
        axis[name] = {**axis.get(name, {}), **section}
    axis["amplifier"].setdefault("gear_ratio", 1.0)
    if model is not None:
        (tmp_path / "model.yaml").write_text(json.dumps(model))
        axis["model"] = "model.yaml"
    file = tmp_path / "axis.yaml"
    file.write_text(json.dumps(axis))
    return file


@pytest.mark.parametrize(("over", "begins"), WEAK, ids=[begins.split(":")[0] for _, begins in WEAK])
def test_value_that_weakens_a_guard_is_warned_of(
    over: dict[str, Any], begins: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (line,) = _warned(_sound(tmp_path, over), capsys)
    assert line.startswith(begins)
    assert run(["config", "check", str(tmp_path / "axis.yaml")]) == 0
    assert f"\n  warning: {line}\n" in capsys.readouterr().out


def test_sound_values_are_not_warned_of(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert _warned(_sound(tmp_path, {}), capsys) == []


def test_a_bus_that_is_forgotten_is_told_of(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = _sound(tmp_path, {})
    file.write_text(json.dumps({key: value for key, value in json.loads(file.read_text()).items() if key != "bus"}))
    (line,) = _warned(file, capsys)
    assert line.startswith("bus.interface is not stated: a virtual axis at /run/servod/vbus0")


def test_limits_beyond_the_model_are_warned_of(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model = parse_yaml((GAINS / "axes" / "demo_joint.yaml").read_text(), "demo_joint")
    model["torque_saturation"] = {"limit": 0.2}
    (line,) = _warned(_sound(tmp_path, {}, model), capsys)
    assert line.startswith("limits.torque_nm 0.3: the joint of") and line.endswith("gives 0.2 at most")


@pytest.mark.parametrize("key", ["limit", "limits.torqe_nm", "torque_n", "limit.torque_nm"])
def test_a_misspelt_key_is_told_what_was_near(key: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["config", "keys", key]) == 2
    meant = capsys.readouterr().err.partition("did you mean ")[2]
    assert "limits" in meant and (key == "limit" or "limits.torque_nm" in meant)


def test_a_group_that_is_not_there_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "axis.yaml"
    text = (GAINS / "config" / "can0.yaml").read_text().replace("../demo_pd.yaml", str(GAINS / "demo_pd.yaml"))
    file.write_text(text.replace("group: servod", "group: nobody-has-this"))
    assert run(["config", "check", str(file)]) == 0
    assert "no group nobody-has-this (control.group)" in capsys.readouterr().out


def test_an_input_whose_broken_wire_is_not_seen_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def check(inputs: dict[str, Any]) -> str:
        config = load_config(GAINS / "config" / "virtual.yaml").model_dump(mode="json", exclude_none=True)
        config["amplifier"]["inputs"] = inputs
        file = tmp_path / "axis.yaml"
        file.write_text(json.dumps(config))
        assert run(["config", "check", str(file)]) == 0
        return capsys.readouterr().out

    assert "broken wire" not in check({"estop_bit": 0, "sto_bit": 1, "sto_active": "low"})
    told = check({"estop_bit": 0, "estop_active": "high", "sto_bit": 1})
    assert "amplifier.inputs.estop_active is high: a broken wire is not seen" in told
    assert "sto_active" not in told


@pytest.mark.parametrize(
    ("brake", "option", "told"),
    [
        ({}, 2, ["a load of 0.1 N*m is more than friction holds: it falls when switched off, without a brake"]),
        ({"by": "drive"}, 2, ["closes after 0.1 s", "falls up to 0.5 rad"]),
        ({"by": "drive"}, 6, ["closes after 0.1 s", "quick_stop_option 6: the drive closes its brake after a stop"]),
        ({"by": "output", "output_bit": 3}, 6, ["closes after 0.1 s", "holds the load, the brake open"]),
        (
            {"by": "output", "output_bit": 3, "engage_s": 0.2},
            2,
            ["closes after 0.2 s", "falls up to 2 rad", "lets go, the brake open: the load falls", "5 to 8 hold until"],
        ),
    ],
)
def test_what_falls_is_told_with_its_distance(
    brake: dict[str, Any], option: int, told: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """0.1 N*m on 0.001 kg*m^2 fall half of 100 rad/s^2 times the time squared."""
    model = (GAINS / "axes/demo_joint.yaml").read_text() + "\ngravity: {amplitude: 0.1, phase: 1.5708}\n"
    (tmp_path / "model.yaml").write_text(model)
    config = load_config(GAINS / "config" / "virtual.yaml").model_dump(mode="json", exclude_none=True)
    config["amplifier"] |= {"brake": brake, "quick_stop_option": option}
    (tmp_path / "axis.yaml").write_text(json.dumps(config | {"model": "model.yaml"}))
    assert run(["config", "check", str(tmp_path / "axis.yaml")]) == 0
    said = capsys.readouterr().out
    assert [text for text in told if text not in said] == []
    assert ("5 to 8 hold until" in said) is ("5 to 8 hold until" in told)
