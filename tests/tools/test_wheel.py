"""The wheel, as somebody else gets it: what is in it, and what works after installing it."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
CORE_IMPORTS = (
    "servod.runtime.daemon.main servod.runtime.loop.process servod.drivers.cia402 servod.drivers.cia406 servod.cli "
    "servod.client.control servod.kernels.scoring"
)
LAB = "numpy scipy numba matplotlib pyarrow cvxpy"
WITHOUT_LAB = f"""
import importlib, sys
for name in {LAB.split()}:
    sys.modules[name] = None
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built from a copy of what git knows, so that no file of the working folder slips in."""
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("dist")
    names = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for name in filter(None, names.split("\0")):
        if (ROOT / name).exists():
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, source / name, follow_symlinks=False)
    pip("wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", str(out), str(source))
    (built,) = out.glob("*.whl")
    return built


def pip(*arguments: str) -> None:
    result = subprocess.run([sys.executable, "-m", "pip", "--quiet", *arguments], capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr


@pytest.fixture(scope="module")
def python(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The interpreter of a fresh environment with the wheel in it; its dependencies are borrowed by path."""
    folder = tmp_path_factory.mktemp("environment")
    venv.create(folder, with_pip=False, symlinks=True)
    site = Path(sysconfig.get_path("purelib", vars={"base": str(folder), "platbase": str(folder)}))
    pip("install", "--no-deps", "--prefix", str(folder), "--ignore-installed", str(wheel))
    (site / "borrowed.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return folder / "bin" / "python"


def run(python: Path, *arguments: str, folder: Path) -> subprocess.CompletedProcess[str]:
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "VIRTUAL_ENV"))}
    return subprocess.run([str(python), *arguments], cwd=folder, env=environment, capture_output=True, text=True)


def test_the_wheel_has_the_package_and_what_ships_with_it_and_nothing_else(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.split("/")[0] for name in names} - {n.split("/")[0] for n in names if ".dist-info" in n} == {"servod"}
    for expected in (
        "servod/drivers/cia402.py",
        "servod/drivers/eds/amplifier.eds",
        "servod/drivers/virtual/main.py",
        "servod/share/gains/demo_local.yaml",
        "servod/share/gains/axes/demo_joint.yaml",
        "servod/share/systemd/servod@.service",
        "servod/py.typed",
    ):
        assert expected in names
    assert len(names) == len(set(names))


@pytest.mark.parametrize("program", ["servoctl", "servod", "servod-virtual-axis"])
def test_the_programs_start(python: Path, tmp_path: Path, program: str) -> None:
    result = run(python, str(python.parent / program), "--help", folder=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "example" in result.stdout.lower()


def test_the_bare_folder_is_not_importable(python: Path, tmp_path: Path) -> None:
    assert run(python, "-c", "import servod.drivers", folder=tmp_path).returncode == 0
    assert "No module named 'drivers'" in run(python, "-c", "import drivers", folder=tmp_path).stderr


def test_the_installed_package_is_the_wheel_and_finds_its_files(python: Path, tmp_path: Path) -> None:
    code = (
        "import servod; from servod.qualify.demo.axis import *; "
        "print(servod.__file__, *map(gains_file, CONTROLLERS), plant_file(None))"
    )
    result = run(python, "-c", code, folder=tmp_path)
    assert result.returncode == 0, result.stderr
    assert all(part.startswith(str(python.parent.parent)) for part in result.stdout.split())


def test_the_core_works_without_the_laboratory(python: Path, tmp_path: Path) -> None:
    code = f"{WITHOUT_LAB}\nfor name in {CORE_IMPORTS.split()}:\n    importlib.import_module(name)"
    result = run(python, "-c", code, folder=tmp_path)
    assert result.returncode == 0, result.stderr


@pytest.mark.parametrize(
    "command",
    [
        *("demo --fast", "demo", "bench --quick", "replay --model axis.yaml run.csv", "plot run.csv"),
        "track paper --plot motion.html",  # before anything moves
    ],
    ids=lambda c: c.split()[0],
)
def test_a_command_that_needs_the_laboratory_says_so_in_one_line(python: Path, tmp_path: Path, command: str) -> None:
    (tmp_path / "axis.yaml").write_text(
        "inertia: 0.001\nfriction: {kind: coulomb_viscous, viscous: 0.1, coulomb: 0.1}\n"
    )
    code = f"{WITHOUT_LAB}\nfrom servod.cli.app import run\nsys.exit(run({command.split()}))"
    result = run(python, "-c", code, folder=tmp_path)
    assert (result.returncode, result.stdout) == (2, "")
    (line,) = result.stderr.splitlines()
    assert line.startswith(f"servoctl: `servoctl {command}` needs servod[lab] (")
    assert "pip install" in line and "servod[lab] @ file://" in line
