"""What is installed is locked, can be told, and nothing of it is executed from data."""

from __future__ import annotations

import ast
import itertools
import json
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
import source
from packaging.requirements import Requirement

#: Each lock and the extras of pyproject.toml in it.
EXTRAS = {"deploy": (), "lab": ("lab",), "dev": ("lab", "dev", "sign"), "fuzz": ("lab", "dev", "sign", "fuzz")}
#: Not on the way from one of these to the next.
BESIDE = {"docs": ("docs",), "browser": ("lab", "browser"), "sign": ("sign",)}
LOCKS = (*EXTRAS, *BESIDE, "build")
#: Which can be installed upon another.
UPON = (*itertools.pairwise(EXTRAS), ("build", "dev"), ("deploy", "docs"), ("docs", "dev"), ("build", "docs"))
UPON += (("lab", "browser"), ("browser", "dev"), ("build", "browser"), ("deploy", "sign"), ("sign", "dev"))
COMMANDS = ("demo", "test")


def locked(name: str) -> list[Requirement]:
    """Every entry of a lock: project, version and where it is installed."""
    text = (source.ROOT / f"requirements/{name}.txt").read_text()
    return [Requirement(entry) for entry in re.findall(r"^(\w[^\\\n]*)", text, re.MULTILINE)]


def versions(name: str) -> dict[str, set[str]]:
    """The versions of each project in a lock: one, or one for some Pythons and another for others."""
    found: dict[str, set[str]] = {}
    for entry in locked(name):
        (pin,) = entry.specifier
        found.setdefault(entry.name.lower(), set()).add(pin.version)
    return found


def wanted(name: str) -> list[Requirement]:
    if name == "build":
        return [Requirement(line) for line in (source.ROOT / "requirements/build.in").read_text().split()]
    project = tomllib.loads((source.ROOT / "pyproject.toml").read_text())["project"]
    extras = (EXTRAS | BESIDE)[name]
    lines = [*project["dependencies"], *(line for e in extras for line in project["optional-dependencies"][e])]
    return [Requirement(line) for line in lines]


@pytest.mark.parametrize("name", LOCKS)
def test_every_dependency_is_locked_within_its_range(name: str) -> None:
    """`scripts/lock` writes them again."""
    found = versions(name)
    outside = [r for r in wanted(name) if not list(r.specifier.filter(found.get(r.name.lower(), ())))]
    assert outside == []


@pytest.mark.parametrize("name", LOCKS)
def test_every_locked_file_has_its_hashes(name: str) -> None:
    entries = re.split(r"^(?=\w)", (source.ROOT / f"requirements/{name}.txt").read_text(), flags=re.MULTILINE)
    entries = [entry for entry in entries if entry.strip()]
    assert len(entries) == len(locked(name)) >= len(wanted(name))
    assert [entry.split()[0] for entry in entries if "--hash=sha256:" not in entry] == []


@pytest.mark.parametrize(("smaller", "larger"), UPON)
def test_what_two_locks_share_has_one_version(smaller: str, larger: str) -> None:
    """One can be installed upon the other: ./demo, then ./test, then the fuzzing."""
    lesser, greater = versions(smaller), versions(larger)
    assert {p: v for p, v in lesser.items() if p in greater and greater[p] != v} == {}
    assert smaller in ("build", *BESIDE) or lesser.keys() <= greater.keys()


@pytest.mark.parametrize("name", ["deploy", "lab", "dev", *BESIDE, "build"])
def test_every_machine_gets_the_same_versions(name: str) -> None:
    every = {str(entry).partition(";")[0] for entry in locked(name)}
    for python, machine in itertools.product(("3.11", "3.12", "3.13", "3.14"), ("x86_64", "aarch64")):
        here = {"python_version": python, "python_full_version": f"{python}.1", "platform_machine": machine}
        here |= {"sys_platform": "linux", "platform_python_implementation": "CPython"}
        got = {str(e).partition(";")[0] for e in locked(name) if e.marker is None or e.marker.evaluate(here)}
        assert got == every, (python, machine)


def test_the_two_commands_install_from_the_locks() -> None:
    asked = {name: re.findall(r"^prepare (\w+)$", (source.ROOT / name).read_text(), re.MULTILINE) for name in COMMANDS}
    assert asked == {"demo": ["lab"], "test": ["dev"]}
    script = (source.ROOT / "scripts/prepare").read_text()
    installs = [line for line in script.splitlines() if "install --no-user" in line]
    assert len(installs) == 2 and all("--require-hashes" in line or "--no-deps" in line for line in installs)


def test_build_backend_is_the_locked_one() -> None:
    project = tomllib.loads((source.ROOT / "pyproject.toml").read_text())
    assert {Requirement(line).name for line in project["build-system"]["requires"]} == {"hatchling"}


def test_bill_of_materials_names_all_that_runs() -> None:
    script = source.ROOT / "scripts/sbom.py"
    bill = json.loads(subprocess.run([sys.executable, script], capture_output=True, text=True, check=True).stdout)
    assert (bill["bomFormat"], bill["metadata"]["component"]["name"]) == ("CycloneDX", "servod")
    names = {component["name"] for component in bill["components"]}
    assert {requirement.name.lower() for requirement in wanted("deploy")} <= names
    assert {"pydantic-core", "rich"} <= names and "pytest" not in names
    assert all(c["purl"] == f"pkg:pypi/{c['name']}@{c['version']}" for c in bill["components"])


# --- nothing is executed from data ------------------------------------------------------------------------------------
#: Calls that turn data into code, or leave a door open.
CALLS = {"eval", "exec", "compile", "__import__", "os.system", "os.popen", "tempfile.mktemp", "yaml.unsafe_load"}
CALLS |= {"yaml.full_load", "yaml.load_all", "marshal.loads", "marshal.load"}
MODULES = {"pickle", "cPickle", "dill", "cloudpickle", "shelve", "marshal", "joblib", "telnetlib", "commands"}
SAFE_LOADERS = {"SafeLoader", "CSafeLoader"}


def dotted(node: ast.AST) -> str:
    """`a.b.c` of a name or attribute; empty for anything else."""
    if isinstance(node, ast.Name):
        return node.id
    return f"{dotted(node.value)}.{node.attr}" if isinstance(node, ast.Attribute) and dotted(node.value) else ""


def offences(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (f"imports {a.name}" for a in node.names if a.name.split(".")[0] in MODULES)
        elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in MODULES:
            yield f"imports {node.module}"
        elif isinstance(node, ast.Call):
            yield from calls(node)


def calls(node: ast.Call) -> Iterator[str]:
    name, given = dotted(node.func), {word.arg: word.value for word in node.keywords}
    if name in CALLS or (name in ("np.load", "numpy.load") and "allow_pickle" not in given):
        yield f"calls {name}"
    for key in ("shell", "allow_pickle"):
        if key in given and not (isinstance(given[key], ast.Constant) and not given[key].value):  # type: ignore[attr-defined]
            yield f"{name}({key}=...)"
    if name == "yaml.load" and not safe_loader(given.get("Loader", node.args[1] if len(node.args) > 1 else node)):
        yield "yaml.load with an unsafe loader"


def safe_loader(node: ast.AST) -> bool:
    """A safe loader of PyYAML, or one of this project's own, which are built on it (test_own_loaders_are_safe)."""
    name = dotted(node)
    return name.split(".")[-1] in SAFE_LOADERS or bool(re.fullmatch(r"_\w*Loader", name))


def test_nothing_is_executed_from_data() -> None:
    found = [
        f"{file.relative_to(source.ROOT)}: {what}"
        for file in [*source.files("servod", "drivers"), *sorted((source.ROOT / "scripts").glob("*.py"))]
        for what in offences(source.tree(file))
    ]
    assert found == []


def test_own_loaders_are_safe() -> None:
    bases = [
        {dotted(base).split(".")[-1] for base in node.bases}
        for file in source.files("servod", "drivers")
        for node in ast.walk(source.tree(file))
        if isinstance(node, ast.ClassDef) and node.name.endswith("Loader") and node.name.startswith("_")
    ]
    safe = SAFE_LOADERS | {"SourceFileLoader"}
    assert bases and all(kinds & (safe | {"_Loader", "_SafeLoader"}) for kinds in bases), bases


@pytest.mark.parametrize(
    "line",
    [
        "eval('1')",
        "import pickle",
        "from pickle import loads",
        "import os; os.system('x')",
        "subprocess.run('x', shell=True)",
        "subprocess.run('x', shell=flag)",
        "np.load(f)",
        "numpy.loadtxt(f, allow_pickle=True)",
        "yaml.load(text)",
        "yaml.load(text, Loader=yaml.FullLoader)",
        "tempfile.mktemp()",
    ],
)
def test_each_offence_would_be_found(line: str) -> None:
    assert list(offences(ast.parse(line)))


# --- nor by the shell -------------------------------------------------------------------------------------------------
SHELL = re.compile(r"#!\s*\S*(?:/|env\s+(?:-\S+\s+)*)(?:ba|da|k|z)?sh\b")
#: Turns data into commands: eval, a shell that is fed or handed a text, a text read as a script.
SHELL_DATA = re.compile(
    r"(?:^|[;&|(]|\b(?:then|do|else)\b)\s*(?:sudo\s+)?eval\s|\|\s*(?:sudo\s+)?(?:\S*/)?(?:ba|da)?sh\b(?!\.)"
    r"|(?:^|[\s;&|(])(?:\S*/)?(?:ba|da)?sh\s+-\w*c\s+[^'\n]*\$|(?:^|[\s;&|(])(?:source|\.|(?:ba|da)?sh)\s+<\(",
    re.MULTILINE,
)


def shell_scripts() -> list[Path]:
    """Every file of the repository that a shell runs, by its first line or its suffix."""
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=source.ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    files = [source.ROOT / name for name in listed.stdout.split("\0") if name]
    return [file for file in files if file.is_file() and (file.suffix == ".sh" or SHELL.match(first_line(file)))]


def first_line(file: Path) -> str:
    with file.open("rb") as stream:
        return stream.readline(200).decode(errors="replace")


def code_lines(text: str) -> str:
    return re.sub(r"^\s*#.*$", "", text, flags=re.MULTILINE)


def test_shell_scripts_do_not_execute_data() -> None:
    scripts = shell_scripts()
    names = {str(script.relative_to(source.ROOT)) for script in scripts}
    assert {"demo", "test", ".ci/run", "scripts/guest", "scripts/branches", "systemd/install.sh"} <= names
    found = {script.name: SHELL_DATA.findall(code_lines(script.read_text())) for script in scripts}
    assert {name: offence for name, offence in found.items() if offence} == {}


@pytest.mark.parametrize(
    "line",
    [
        'eval "$x"',
        "true && eval $x",
        "if x; then eval $x; fi",
        "curl -s https://x | sh",
        "curl x | sudo bash -s",
        "cat x | /bin/sh",
        'bash -c "$x"',
        "sh -ec $x",
        "source <(curl x)",
        "bash <(curl x)",
    ],
)
def test_each_offence_of_a_shell_would_be_found(line: str) -> None:
    assert SHELL_DATA.search(code_lines(line))


@pytest.mark.parametrize("line", ["#!/bin/sh", "#!/usr/bin/env bash", "#! /bin/bash -e", "#!/usr/bin/env -S bash"])
def test_a_shell_script_is_known_by_its_first_line(line: str) -> None:
    assert SHELL.match(line) and not SHELL.match("#!/usr/bin/env python3")
