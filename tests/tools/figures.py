"""The figures of the house: what can be counted of the plan in docs/architecture.md. `python tests/tools/figures.py`.

Prints one line for each figure with its bound, and ends with 1 where one does not hold.
"""

from __future__ import annotations

import ast
import re
import sys
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import grimp
import source

FLOORS = ("common", "kernels", "formats", "runtime", "client", "lab", "qualify", "cli")
FOLDERS = {*FLOORS, "drivers"}
DIAGNOSE = "servod.lab.diagnose"
#: A name with two underscores of another class, as Python mangles it.
_MANGLED = re.compile(r"_[A-Za-z]\w*__\w")
_DOCUMENTED = {"_fields", "_replace", "_asdict", "_make", "_exit", "_MEIPASS", "_getframe"}


class Figure(NamedTuple):
    """One figure, its bound (at most), and what to look at where it is above."""

    name: str
    value: float
    most: float
    where: list[str]


def _components(graph: dict[str, set[str]]) -> Iterator[set[str]]:
    """Strongly connected components of more than one node (Tarjan), without recursion."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    on: set[str] = set()
    for root, reached in graph.items():
        if root in index:
            continue
        work = [(root, iter(sorted(reached)))]
        index[root] = low[root] = len(index)
        stack.append(root)
        on.add(root)
        while work:
            node, successors = work[-1]
            for after in successors:
                if after not in index:
                    index[after] = low[after] = len(index)
                    stack.append(after)
                    on.add(after)
                    work.append((after, iter(sorted(graph[after]))))
                    break
                if after in on:
                    low[node] = min(low[node], index[after])
            else:
                work.pop()
                if work:
                    low[work[-1][0]] = min(low[work[-1][0]], low[node])
                if low[node] == index[node]:
                    found = set()
                    while node not in found:
                        found.add(stack.pop())
                    on -= found
                    if len(found) > 1:
                        yield found


def import_graph() -> dict[str, set[str]]:
    """Module -> modules of servod that it imports anywhere in it, also for typing only."""
    graph = grimp.build_graph("servod", cache_dir=None)
    return {m: set(graph.find_modules_directly_imported_by(m)) for m in graph.modules}


def _is_package(module: str, graph: Iterable[str]) -> bool:
    return any(other.startswith(module + ".") for other in graph)


def _circles(graph: dict[str, set[str]]) -> Figure:
    found = [" <-> ".join(sorted(c)) for c in _components(graph)]
    return Figure("circles of imports, typing included", len(found), 0, found)


def _upward(graph: dict[str, set[str]]) -> Figure:
    rank = {name: number for number, name in enumerate(FLOORS)}
    wrong = []
    for module, imported in graph.items():
        for other in imported:
            mine, theirs = (m.split(".")[1] if "." in m else "" for m in (module, other))
            if mine in rank and theirs in rank and rank[theirs] > rank[mine]:
                wrong.append(f"{module} imports {other}")
    return Figure("imports that run upward", len(wrong), 0, wrong)


def _floors(graph: dict[str, set[str]]) -> Figure:
    """Floors of lab/diagnose: its packages and loose modules as rooms, each above all that it imports."""

    def room(module: str) -> str:
        return ".".join(module.split(".")[:4])

    rooms: dict[str, set[str]] = defaultdict(set)
    for module, imported in graph.items():
        if module.startswith(DIAGNOSE + "."):
            rooms[room(module)] |= {room(o) for o in imported if o.startswith(DIAGNOSE + ".")} - {room(module)}
    packages = {r for r in rooms if _is_package(r, graph)}
    edges = {r: {o for o in rooms[r] if o in packages} for r in packages}
    height: dict[str, int] = {}

    def floor(name: str, above: tuple[str, ...] = ()) -> int:
        if name in above:
            return 99
        if name not in height:
            height[name] = 1 + max((floor(o, (*above, name)) for o in edges[name]), default=0)
        return height[name]

    heights = {r: floor(r) for r in packages}
    top = 1 + max(heights.values(), default=0)  # the loose modules: engine, document
    return Figure("floors of lab/diagnose", top, 6, [f"{r}: {h}" for r, h in sorted(heights.items())])


def _loose(graph: dict[str, set[str]]) -> Iterator[Figure]:
    top = {m.split(".")[1] for m in graph if m.count(".") >= 1}
    yield Figure("folders of servod", len(top), len(FOLDERS), sorted(top))
    loose = sorted(m for m in graph if m.count(".") == 1 and not _is_package(m, graph))
    yield Figure("loose modules of servod", len(loose), 0, loose)
    yield Figure("layers", len(FLOORS), 8, [])


def _one_importer(graph: dict[str, set[str]]) -> Figure:
    importers: Counter[str] = Counter(other for imported in graph.values() for other in imported)
    modules = [m for m in graph if not _is_package(m, graph)]
    single = sorted(m for m in modules if importers[m] == 1)
    return Figure("modules with one importer, %", round(100.0 * len(single) / len(modules), 1), 15, single)


def _twice() -> Figure:
    where: dict[str, list[str]] = defaultdict(list)
    for file in source.files("servod", "drivers"):
        for node in source.tree(file).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                where[node.name].append(str(file.relative_to(source.ROOT)))
    twice = [f"{name}: {', '.join(files)}" for name, files in sorted(where.items()) if len(files) > 1]
    return Figure("public class names that exist twice", len(twice), 5, twice)


def effects() -> Figure:
    """How far the name of an effect is spread: files that have it as a string, outside the folder of the records."""
    folder = source.ROOT / "servod/lab/diagnose/effects"
    records = {f.stem: f.read_text() for f in sorted(folder.glob("*.py"))}
    names = {name: "group=None" in text for name, text in records.items() if re.search(r"^EFFECT\b", text, re.M)}
    where: dict[str, set[str]] = {name: set() for name in names}
    for file in source.files("servod", "drivers"):
        if folder not in file.parents:
            for name in named(source.tree(file), names):
                where[name].add(str(file.relative_to(source.ROOT)))
    told = [f"{name}: {len(files)} {', '.join(sorted(files))}".rstrip() for name, files in where.items()]
    return Figure("files that name one effect, outside its own", max(map(len, where.values()), default=0), 6, told)


def named(tree: ast.AST, names: dict[str, bool]) -> Iterator[str]:
    """Strings of a file that are an effect's name; of the `names`, those with True are a number of every model too.

    Such a number (inertia, torque_offset) beside others that are no effects, in one list or as keys or values of one
    table, is what it says and names no effect.
    """
    lists: list[list[ast.expr | None]] = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Tuple | ast.List | ast.Set):
            lists.append(list(node.elts))
        elif isinstance(node, ast.Dict):
            lists += [list(node.keys), list(node.values)]
    quantities = set()
    for members in lists:
        texts = [member for member in members if isinstance(member, ast.Constant) and isinstance(member.value, str)]
        if any(text.value not in names for text in texts):
            quantities |= {id(text) for text in texts}
    for node in ast.walk(tree):
        word = node.value if isinstance(node, ast.Constant) and isinstance(node.value, str) else ""
        if word in names and not (names[word] and id(node) in quantities):
            yield word


def _private() -> Figure:
    """Uses of a private attribute of something that is not our own: library modules and what they return."""
    found = []
    for file in source.files("servod", "drivers"):
        outside = {
            (alias.asname or alias.name).split(".")[0]
            for node in ast.walk(source.tree(file))
            if isinstance(node, ast.Import | ast.ImportFrom)
            for alias in node.names
            if (getattr(node, "module", None) or alias.name).split(".")[0] != "servod"
        }
        for node in ast.walk(source.tree(file)):
            if isinstance(node, ast.ImportFrom) and not (node.module or "").startswith("servod"):
                found += [
                    f"{file.relative_to(source.ROOT)}:{node.lineno} {a.name}" for a in node.names if _secret(a.name)
                ]
            if isinstance(node, ast.Attribute) and _MANGLED.match(node.attr):
                found.append(f"{file.relative_to(source.ROOT)}:{node.lineno} {ast.unparse(node)}")
            elif isinstance(node, ast.Attribute) and _secret(node.attr):
                root = ast.unparse(node.value).split(".")[0].split("(")[0]
                if root in outside:
                    found.append(f"{file.relative_to(source.ROOT)}:{node.lineno} {ast.unparse(node)}")
    return Figure("private attributes of libraries", len(found), 0, found)


def _secret(name: str) -> bool:
    return name.startswith("_") and not name.startswith("__") and name not in _DOCUMENTED


def _lines() -> Figure:
    count = sum(f.read_text().count("\n") for f in source.files("servod", "drivers"))
    return Figure("lines of servod and drivers", count, 50_000, [])


def figures() -> list[Figure]:
    """All figures, in the order in which they are printed."""
    graph = import_graph()
    return [
        *_loose(graph),
        _circles(graph),
        _upward(graph),
        _floors(graph),
        _one_importer(graph),
        _twice(),
        effects(),
        _private(),
        _lines(),
    ]


def main(arguments: list[str]) -> int:
    """Print the figures; with --where also the places."""
    held = True
    for figure in figures():
        good = figure.value <= figure.most
        held &= good
        print(f"{'holds' if good else 'ABOVE':6} {figure.name}: {figure.value:g} (at most {figure.most:g})")
        if "--where" in arguments or ("--above" in arguments and not good):
            print("".join(f"         {line}\n" for line in figure.where), end="")
    return 0 if held else 1


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
    raise SystemExit(main(sys.argv[1:]))
