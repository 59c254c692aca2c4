"""Changes the limits, the axis and the CiA 402 tables in every small way there is, and sees whether a test notices.

    pip install -e .[dev,mutation]
    nice python scripts/mutate.py                 all of it, about a quarter of an hour on one core
    nice python scripts/mutate.py limits axis     these files
    nice python scripts/mutate.py --sample 100    a hundred changes, drawn again with --seed

A change (a mutant: another operator, number, comparison or branch, by the operators of cosmic-ray) that no test notices
has survived. Those that no test can know of stand in scripts/mutate_survivors.yaml with the reason; any other
survivor, and an entry that survives no more, is an error. No file is touched: each mutant lives in its own process.
"""

from __future__ import annotations

import argparse
import ast
import importlib.machinery
import importlib.util
import os
import random
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parents[1]
SURVIVORS = ROOT / "scripts/mutate_survivors.yaml"
#: A mutant that makes the tests compute for so long has been noticed, or wait for so long: on a busy machine it waits.
_LONGEST_CPU_S, _LONGEST_S = 20, 300
_HYPOTHESIS_EXAMPLES = 40
#: Replacements that say nothing new: who notices "-" for "+" notices "%" as well, and equal states are the same ones.
_LEFT_OUT = ("_Is", "_IsNot", "_Is_Eq", "_IsNot_NotEq", "_FloorDiv", "_Mod", "_Pow", "_RShift", "_LShift")
_PRELOADED = (
    "hypothesis",
    "pydantic",
    "pytest",
    "yaml",
    "canopen",
    "can",
    "servod.formats.config",
    "servod.common.errors",
    "servod.runtime.fieldbus.devices",
    "servod.runtime.loop.commands",
)


class Target(NamedTuple):
    """A file that is mutated, and the tests that must notice."""

    path: str
    module: str
    tests: tuple[str, ...]


TARGETS = {
    "limits": Target(
        "servod/runtime/loop/limits.py",
        "servod.runtime.loop.limits",
        ("tests/runtime/loop/boundary/test_limits.py", "tests/runtime/loop/test_limits.py"),
    ),
    "axis": Target(
        "servod/runtime/loop/axis.py",
        "servod.runtime.loop.axis",
        (
            "tests/runtime/loop/boundary/test_axis.py",
            "tests/runtime/loop/boundary/test_axis_drive.py",
            "tests/runtime/loop/test_axis_scenarios.py",
        ),
    ),
    "cia": Target(
        "servod/runtime/fieldbus/cia.py", "servod.runtime.fieldbus.cia", ("tests/runtime/fieldbus/test_cia.py",)
    ),
    "cia402_state": Target(
        "drivers/cia402_state.py",
        "servod.drivers.cia402_state",
        ("tests/drivers/test_cia402_state.py", "tests/conformance/test_transitions.py"),
    ),
    "cia402_target": Target(
        "drivers/cia402_target.py",
        "servod.drivers.cia402_target",
        ("tests/drivers/test_cia402_target.py", "tests/conformance/test_modes.py"),
    ),
    "cia402": Target(
        "drivers/cia402.py",
        "servod.drivers.cia402",
        (
            "tests/drivers/test_cia402.py",
            "tests/drivers/test_cia402_command.py",
            "tests/conformance/test_amplifiers.py",
            "tests/conformance/test_modes.py",
        ),
    ),
    "cia402_setup": Target(
        "drivers/cia402_setup.py",
        "servod.drivers.cia402_setup",
        ("tests/drivers/test_cia402_setup.py", "tests/drivers/test_cia402_guards.py"),
    ),
}


class Mutant(NamedTuple):
    """One change: the lines before and after, and the whole file with it."""

    path: str
    module: str
    line: int
    before: str
    after: str
    code: str

    @property
    def key(self) -> tuple[str, str, str]:
        """What an entry of the survivors names it by; lines may move."""
        return self.path, self.before, self.after

    def __str__(self) -> str:
        return f"{self.path}:{self.line}\n  - {self.before}\n  + {self.after}"


def mutants(target: Target) -> Iterator[Mutant]:
    """All changes of one file that change what it does: none of annotations."""
    import parso.python.tree  # noqa: F401  (cosmic-ray imports it in an order that fails)
    from cosmic_ray.ast import ast_nodes, get_ast
    from cosmic_ray.mutating import mutate_code
    from cosmic_ray.plugins import get_operator, operator_names

    source = (ROOT / target.path).read_text(encoding="utf-8")
    seen, nodes = {_meaning(source)}, list(ast_nodes(get_ast(source)))
    for name in sorted(operator_names()):
        kind = get_operator(name)
        if kind.arguments() or name.endswith(_LEFT_OUT):
            continue
        operator = kind()
        count = sum(1 for node in nodes for _ in operator.mutation_positions(node))
        for occurrence in range(count):
            code = mutate_code(source, operator, occurrence)
            if code is not None and (meaning := _meaning(code)) not in seen:
                seen.add(meaning)
                yield Mutant(target.path, target.module, *_changed_lines(source, code), code)


def _meaning(source: str) -> str:
    """The syntax tree without annotations, which nobody evaluates; the source itself where it is no Python."""
    try:
        tree = ast.parse(source)
    except SyntaxError:
        return ""
    for node in ast.walk(tree):
        if isinstance(node, ast.arg):
            node.annotation = None
        elif isinstance(node, ast.FunctionDef):
            node.returns = None
        elif isinstance(node, ast.AnnAssign):
            node.annotation = ast.Constant(None)
    return ast.dump(tree)


def _changed_lines(source: str, code: str) -> tuple[int, str, str]:
    """The first line that differs, and how it was and is."""
    before, after = source.splitlines(), code.splitlines()
    line = next(n for n, (a, b) in enumerate(zip(before, after, strict=False)) if a != b)
    return line + 1, before[line].strip(), after[line].strip()


class _Loader(importlib.machinery.SourceFileLoader):
    """Gives one module the mutant's code."""

    def __init__(self, mutant: Mutant) -> None:
        super().__init__(mutant.module, str(ROOT / mutant.path))
        self._code = mutant.code

    def get_code(self, fullname: str) -> Any:
        """Compiled from memory, never from a cache."""
        return self.source_to_code(self._code.encode(), self.path)


class _Finder:
    """First in sys.meta_path."""

    def __init__(self, mutant: Mutant) -> None:
        self._mutant = mutant

    def find_spec(self, name: str, path: object = None, target: object = None) -> importlib.machinery.ModuleSpec | None:
        """The mutant's module is this one; all others are found as ever."""
        if name != self._mutant.module:
            return None
        return importlib.util.spec_from_loader(name, _Loader(self._mutant), origin=str(ROOT / self._mutant.path))


def survives(mutant: Mutant | None, tests: Sequence[str]) -> bool:
    """Whether the tests pass with the mutant, or as the files are when there is none; in a child process."""
    child = os.fork()
    if child == 0:
        signal.setitimer(signal.ITIMER_PROF, _LONGEST_CPU_S)
        signal.alarm(_LONGEST_S)
        silence = os.open(os.devnull, os.O_WRONLY)
        os.dup2(silence, 1)
        os.dup2(silence, 2)
        if mutant is not None:
            sys.meta_path.insert(0, _Finder(mutant))  # type: ignore[arg-type]
        os._exit(_run(tests))
    _, status = os.waitpid(child, 0)
    return os.waitstatus_to_exitcode(status) == 0


def _run(tests: Sequence[str]) -> int:
    import pytest
    from hypothesis import Phase, settings

    settings.register_profile(
        "mutation",
        deadline=None,
        derandomize=True,
        database=None,
        max_examples=_HYPOTHESIS_EXAMPLES,
        phases=(Phase.explicit, Phase.generate),
    )
    options = ["-x", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", "--hypothesis-profile=mutation", "--tb=no"]
    return int(pytest.main([*options, *(str(ROOT / test) for test in tests)]))


def explained() -> dict[tuple[str, str, str], str]:
    """The survivors that no test can notice, with the reason."""
    import yaml

    entries = yaml.safe_load(SURVIVORS.read_text(encoding="utf-8")) or []
    return {(e["file"], e["before"], e["after"]): e["reason"] for e in entries}


def campaign(names: Sequence[str], sample: int | None, seed: int) -> list[Mutant]:
    """All survivors among the mutants of the targets; tells how far it is."""
    survivors, begun = [], time.monotonic()
    for name in names:
        target = TARGETS[name]
        if not survives(None, target.tests):
            sys.exit(f"mutate: {name}: its tests fail without any change")
        chosen = list(mutants(target))
        if sample is not None:
            chosen = random.Random(seed).sample(chosen, min(sample, len(chosen)))  # noqa: S311  (no secret)
        found = list(_survivors(chosen, target.tests))
        survivors += found
        spent_s = time.monotonic() - begun
        print(f"{name}: {len(chosen)} mutants, {len(found)} survive ({spent_s:.0f} s so far)", flush=True)
    return survivors


def _survivors(chosen: Sequence[Mutant], tests: Sequence[str]) -> Iterator[Mutant]:
    """Those that live, told as soon as they are known: a campaign is long."""
    for mutant in chosen:
        if survives(mutant, tests):
            print(f"survives: {mutant}", flush=True)
            yield mutant


def main() -> int:
    """Run the campaign; 1 when a survivor is not explained, or when an explained one is noticed after all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("targets", nargs="*", choices=[[], *TARGETS], help="files; all when none is named")
    parser.add_argument("--sample", type=int, help="so many mutants of each file, drawn at random")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    names = options.targets or list(TARGETS)
    for module in _PRELOADED:
        importlib.import_module(module)
    assert not {target.module for target in TARGETS.values()} & set(sys.modules)
    os.chdir(ROOT)
    survivors, known = campaign(names, options.sample, options.seed), explained()
    new = [mutant for mutant in survivors if mutant.key not in known]
    paths = {TARGETS[name].path for name in names}
    stale = [key for key in known if key[0] in paths and key not in {m.key for m in survivors}]
    if options.sample is None:
        for path, before, after in stale:
            print(f"noticed after all, or gone: {path}\n  - {before}\n  + {after}")
    for mutant in new:
        print(f"not explained: {mutant}")
    print(f"{len(survivors)} survivors, {len(new)} of them not explained")
    return 1 if new or (stale and options.sample is None) else 0


if __name__ == "__main__":
    sys.exit(main())
