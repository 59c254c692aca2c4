"""Targets that are text files: EDS and DCF, every YAML file, and the motions of `servoctl track csv`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import yaml

import servod.drivers
from servod.common.yaml import load_model
from servod.drivers.virtual.settings import VirtualAxisSettings
from servod.formats.config import load_config
from servod.formats.gains.gain_set import parse_gains
from servod.formats.gains.store import GainStore
from servod.formats.model.axis_model import load_axis_model
from servod.runtime.fieldbus.master.eds import load_dictionary
from servod.runtime.fieldbus.master.node import left_out, parameters
from tests.fuzz.shapes import csv_texts, mutated, yaml_texts
from tests.fuzz.target import Target

ROOT = Path(__file__).resolve().parents[2]
EDS_FOLDER = Path(servod.drivers.__file__).parent / "eds"
_EDS_WORDS = tuple(
    f"\n{line}".encode()
    for line in (
        *("[1000]", "[1018sub1]", "[1003Name]", "[DummyUsage]", "[Comments]", "[DeviceComissioning]", "[1A00]", "[]"),
        *("ObjectType=0x8", "DataType=0x0007", "CompactSubObj=255", "NrOfEntries=99999999", "SubNumber=300", "Lines=9"),
        *("DefaultValue=$NODEID+0x180", "DefaultValue=0x", "ParameterValue=1e3", "LowLimit=-0x80", "HighLimit=x", "a"),
        *("AccessType=rww", "PDOMapping=2", "NodeID=300", "Baudrate=1e9", "ParameterName=", "DefaultValue=%(x)s"),
    )
)
_YAML_WORDS = tuple(
    word.encode()
    for word in (
        *(
            ": ",
            "- ",
            "\n",
            "&a ",
            "*a",
            "!!",
            "<<: ",
            "? ",
            "|",
            ">",
            "[",
            "]",
            "{",
            "}",
            "---\n",
            "...\n",
            "%YAML 1.2\n",
        ),
        *(
            "kind: lugre",
            ".nan",
            ".inf",
            "1e308",
            "null",
            "true",
            "0x1",
            '"\\ud800"',
            "!!timestamp ",
            "!!bool ",
            "!!set ",
        ),
    )
)
_CONFIGURATION = b"""
name: axis
bus: {interface: virtual, channel: /run/servod/vbus0, bit_rate: 1000000, options: {a: 1}}
cycle: {period_us: 1000, feedback_timeout_us: 600}
heartbeat: {drive_timeout_ms: 150}
amplifier: {node_id: 1, quirks: none, identity: {vendor_id: 1}}
encoder: {node_id: 2}
limits: {torque_nm: 1.0, torque_rate_nm_per_s: 100.0, speed_rad_s: 3.0, position_min_rad: -1.0, position_max_rad: 1.0,
  following_error_rad: 0.1, encoder_mismatch_rad: 0.05}
gains: {initial: gains.yaml, accept_uncertified: true}
"""
_GAINS = b"""
schema_version: 1
name: trial
parameters: {law: pd, position_gain_nm_per_rad: 2.5, velocity_gain_nms_per_rad: 0.12}
provenance: {author: the test, date: "2026-01-01"}
"""
_MODEL = b"""
inertia: 0.001
friction: {kind: lugre, sigma0: 950.0, sigma1: 1.0, viscous: 0.056, coulomb: 0.045, static: 0.07}
gravity: {amplitude: 0.1, phase: 0.0}
cogging: {harmonics: [{amplitude: 0.01, periods_per_turn: 4}]}
"""
_MAP = b"columns: {t_s: t, force_n: {from: vir, scale: 35.15}, position_m: qm}\n"


def _file(path: Path, read: Callable[[Path], object]) -> Callable[[bytes], object]:
    """Hands bytes in as the file `path`."""

    def run(data: bytes) -> None:
        path.write_bytes(data)
        read(path)

    return run


def _yaml(path: Path, read: Callable[[Path], object], *seeds: bytes) -> Target:
    return Target(_file(path, read), seeds, yaml_texts(seeds), _YAML_WORDS)


def _shipped(*names: str) -> list[bytes]:
    return [(ROOT / "gains" / name).read_bytes() for name in names]


def eds(folder: Path) -> Target:
    """The dictionary of a node, as a configuration names it."""
    whole = (EDS_FOLDER / "encoder.eds").read_bytes()
    seeds = (
        whole[:1500],
        whole[:300],
        b"[1000]\nParameterName=Type\nObjectType=0x7\nDataType=0x0007\n",
    )
    read = _file(folder / "node.eds", lambda path: load_dictionary(path, 5))
    return Target(read, seeds, mutated(seeds, _EDS_WORDS), _EDS_WORDS)


def dcf(folder: Path) -> Target:
    """The values that a DCF gives to a node's parameters."""
    seed = b"""[DeviceInfo]
VendorName=x
[2000]
ParameterName=Own
ObjectType=0x7
DataType=0x0004
AccessType=rw
ParameterValue=0x10
[6040]
ParameterName=Control word
ObjectType=0x8
DataType=0x0006
AccessType=rw
CompactSubObj=3
DefaultValue=1
[6040Name]
NrOfEntries=2
1=one
2=two
"""

    def read(path: Path) -> None:
        dictionary = load_dictionary(path, 5)
        list(parameters(dictionary))
        left_out(dictionary)

    return Target(_file(folder / "node.dcf", read), (seed,), mutated((seed,), _EDS_WORDS), _EDS_WORDS)


def configuration(folder: Path) -> Target:
    """The axis's own file."""
    return _yaml(folder / "axis.yaml", load_config, _CONFIGURATION, *_shipped("config/virtual.yaml"))


def gains(folder: Path) -> Target:
    """A gain set, and all that is asked of it afterwards."""

    def run(data: bytes) -> None:
        found = parse_gains(data.decode("utf-8", "surrogatepass"), "gains.yaml")
        found.pack()
        found.certificate_problem()
        assert parse_gains(found.to_yaml(), "again") == found

    seeds = (_GAINS, *_shipped("demo_local_plain.yaml", "demo_pd_lugre.yaml", "demo_pd_dob.yaml"))
    return Target(lambda data: run(_utf8(data)), seeds, yaml_texts(seeds), _YAML_WORDS, longest=20_000)


def _utf8(data: bytes) -> bytes:
    """Text of gain sets comes in as text: bytes that are none cannot come."""
    return data.decode("utf-8", "replace").encode()


def gain_store(folder: Path) -> Target:
    """A set's way into the store: what is refused leaves no file."""
    store = GainStore(folder / "store")

    def run(data: bytes) -> None:
        before = sorted((folder / "store").rglob("*"))
        try:
            store.load(data.decode("utf-8", "replace"), "request")
        except BaseException:
            assert sorted((folder / "store").rglob("*")) == before
            raise
        store.stored()

    return Target(run, (_GAINS,), yaml_texts((_GAINS,)), _YAML_WORDS)


def axis_model(folder: Path) -> Target:
    """An axis model, and the parameters of the simulator that it becomes."""

    def read(path: Path) -> None:
        load_axis_model(path).pack()

    return _yaml(folder / "model.yaml", read, _MODEL, *_shipped("axes/demo_joint.yaml"))


def column_map(folder: Path) -> Target:
    """A `--map` file."""
    from servod.lab.recordings import load_column_map

    return _yaml(folder / "map.yaml", load_column_map, _MAP)


def virtual_axis_settings(folder: Path) -> Target:
    """The settings of the virtual axis."""
    seed = yaml.safe_dump(VirtualAxisSettings().model_dump(mode="json")).encode()
    return _yaml(folder / "axis.yaml", lambda path: load_model(path, VirtualAxisSettings), seed)


def config_check(folder: Path) -> Target:
    """`servoctl config check`, which recognises a YAML file by its keys and follows the files that it names."""
    from servod.cli.config import check

    (folder / "gains.yaml").write_bytes(_GAINS)
    return _yaml(folder / "odd.yaml", lambda path: check([path], True), _CONFIGURATION, _GAINS, _MODEL, _MAP)


def motion(folder: Path) -> Target:
    """A reference motion, put on the loop's grid."""
    from servod.cli.track import COLUMNS, read_motion

    seed = b"t_s,reference_rad\n0,0\n0.5,0.1\n1.0,0.2\n"
    read = _file(folder / "motion.csv", lambda path: read_motion(path).on_grid(1e-3))
    return Target(read, (seed,), csv_texts(COLUMNS), (b"1e999", b"nan", b'"', b"\0", b"#", b"1e12"))


def fault_scenarios(folder: Path) -> Target:
    """A file of scenarios of the fault campaign, with its variants."""
    from servod.qualify.faults.variants import load_scenarios, scenarios_in

    shipped = ROOT / "servod" / "qualify" / "faults" / "scenarios" / "bus"
    assert scenarios_in(shipped)
    seeds = [file.read_bytes() for file in sorted(shipped.glob("*.yaml"))[:4]]
    return _yaml(folder / "scenario.yaml", load_scenarios, *seeds)
