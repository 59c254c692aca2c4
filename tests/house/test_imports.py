"""Imports run one way, the loop stays lean, and the bare folder `drivers` is never imported."""

from __future__ import annotations

import subprocess
import sys

import pytest
import source

#: From the ground up. A module may import its own layer and those below, nothing above.
LAYERS: list[set[str]] = [
    {"units", "errors", "end_signals", "files", "yaml12", "shipped", "sources", "notify", "workers"},
    {"hal", "cia", "clock", "commands", "config", "record", "realtime", "bus", "wiring_proof"},
    {"identified"},
    {"axis_keys", "axis_friction", "axis_effects", "axis_model", "axis_pack", "models", "controllers"}
    | {"gain_parameters", "gain_design", "gains", "gain_verdict", "gain_store"},
    {"drivers", "limits", "axis", "references"},
    {"master", "recorder_mcap", "recorder_read", "recorder_history", "recorder_files", "recorder_export", "recordings"},
    {"loop", "control", "recorder", "metrics", "wiring_expected"},
    {"daemon", "daemon_config", "daemon_recording", "session", "replay"},
    {"identify"},
    {"verify"},
    {"synthesize"},
    {"diagnose"},
    {"deploy"},
    {"tracking"},
    {"tune"},
    {"demo"},
    {"report"},
    {"commission"},
    {"recovery"},
    {"paper"},
    {"prove"},
    {"campaign"},
    {"soak"},
    {"benchmark"},
    {"cli"},
]
LAYER_OF = {name: rank for rank, names in enumerate(LAYERS) for name in names}

#: What a blind trial is about: its plant and its cases share nothing with them.
_SUBJECT = (
    *("servod.models", "servod.axis_keys", "servod.axis_friction", "servod.axis_effects", "servod.axis_model"),
    "servod.diagnose",
)

#: Whoever is on the left never imports what is on the right, whatever their layers say.
NEVER = {
    "servod.models": ("servod.bus", "servod.hal", "servod.master", "servod.drivers", "servod.config"),
    "servod.controllers": ("servod.models", "servod.axis_model", "servod.bus"),
    "servod.drivers.cia402": ("servod.models", "servod.axis_model", "servod.drivers.virtual"),
    "servod.drivers.cia406": ("servod.models", "servod.axis_model", "servod.drivers.virtual"),
    "servod.drivers.virtual": ("servod.master", "servod.loop", "servod.axis", "servod.controllers", "servod.limits"),
    "servod.master": ("servod.models", "servod.axis_model", "servod.drivers.virtual"),
    "servod.prove.plant": _SUBJECT,
    "servod.prove.physics": _SUBJECT,
    "servod.prove.axes": _SUBJECT,
    "servod.prove.hidden": _SUBJECT,
    "servod.prove.unlisted": _SUBJECT,
    "servod.prove.case": _SUBJECT,
    "servod.prove.truth": _SUBJECT,
    "servod.loop": ("servod.models", "servod.axis_model", "servod.drivers.virtual", "canopen", "can"),
    "servod.daemon": ("servod.models", "servod.drivers.virtual"),
}

#: The lazy table of buses names the virtual bus, whose few lines of socket code stand beside the hub.
EXCEPTIONS = {("servod.bus.open", "servod.drivers.virtual.client")}

#: The files by which an identification reaches an axis, and what nothing else in it may import.
LINKS = {"servod.identify.links", "servod.identify.virtual", "servod.identify.daemon_link"}
_AXIS = (
    *("servod.bus", "servod.control", "servod.daemon", "servod.daemon_config", "servod.daemon_recording"),
    *("servod.drivers.virtual", "servod.loop", "servod.master", "servod.session"),
)

LAB = {"numpy", "scipy", "numba", "llvmlite", "plotly", "matplotlib", "pyarrow", "cvxpy", "clarabel", "scs", "pandas"}
CORE = ["servod.daemon.main", "servod.loop.process", "servod.drivers.cia402", "servod.drivers.cia406", "servod.cli"]


def layer(module: str) -> int | None:
    """Rank of a module of servod; None for the package itself and for everything else."""
    parts = module.split(".")
    if parts[0] != "servod" or len(parts) < 2:
        return None
    return LAYER_OF.get(parts[1])


def test_every_module_has_a_layer() -> None:
    names = {
        source.module_name(f).split(".")[1]
        for f in source.files("servod", "drivers")
        if f.parent != source.ROOT / "servod" or f.stem != "__init__"
    }
    assert names - set(LAYER_OF) == set()


def test_imports_run_one_way() -> None:
    wrong = []
    for file in source.files("servod", "drivers"):
        module = source.module_name(file)
        own = layer(module)
        for name, line in source.imports(file):
            rank = layer(name)
            allowed = any(module == who and name.startswith(what) for who, what in EXCEPTIONS)
            if own is not None and rank is not None and rank > own and not allowed:
                wrong.append(f"{file.relative_to(source.ROOT)}:{line} {module} imports {name}")
    assert wrong == []


@pytest.mark.parametrize("module", NEVER)
def test_neighbours_keep_apart(module: str) -> None:
    wrong = [
        f"{file.relative_to(source.ROOT)}:{line} imports {name}"
        for file in source.files("servod", "drivers")
        if source.module_name(file).startswith(module)
        for name, line in source.imports(file)
        if any(name == banned or name.startswith(banned + ".") for banned in NEVER[module])
    ]
    assert wrong == []


def test_only_the_links_of_an_identification_know_an_axis() -> None:
    wrong = [
        f"{file.relative_to(source.ROOT)}:{line} imports {name}"
        for file in source.files("servod/identify")
        if source.module_name(file) not in LINKS
        for name, line in source.imports(file)
        if any(name == banned or name.startswith(banned + ".") for banned in _AXIS)
    ]
    assert wrong == []


@pytest.mark.parametrize("part", ["fits", "analysis", "result", "store", "signals", "estimate", "changes"])
def test_fits_know_recordings_and_no_link(part: str) -> None:
    wrong = [
        f"{file.relative_to(source.ROOT)}:{line} imports {name}"
        for file in source.files("servod/identify")
        if source.module_name(file).startswith(f"servod.identify.{part}")
        for name, line in source.imports(file)
        if name in {*LINKS, "servod.identify.walk"} or name.startswith("servod.identify.experiments")
    ]
    assert wrong == []


def test_nobody_imports_the_bare_folder() -> None:
    wrong = [
        f"{file.relative_to(source.ROOT)}:{line}"
        for file in source.files()
        for name, line in source.imports(file)
        if name == "drivers" or name.startswith("drivers.")
    ]
    assert wrong == []


@pytest.mark.parametrize("module", CORE)
def test_the_core_imports_nothing_of_the_laboratory(module: str) -> None:
    code = f"import sys, {module}; print(' '.join(sorted({{m.split('.')[0] for m in sys.modules}})))"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert set(result.stdout.split()) & LAB == set()


def test_the_loop_imports_neither_canopen_nor_python_can() -> None:
    code = "import sys, servod.loop.process; print(' '.join(sys.modules))"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert {m.split(".")[0] for m in result.stdout.split()} & {"canopen", "can", "typer", "rich", "mcap"} == set()


def test_the_command_line_starts_without_the_daemon_and_the_laboratory() -> None:
    code = "import sys, servod.cli; print(' '.join(sys.modules))"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(result.stdout.split())
    assert not {m for m in loaded if m.startswith(("servod.daemon", "servod.loop", "servod.master", "canopen", "mcap"))}
