"""The project's own source files, parsed once, for the house rules."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = ("servod", "drivers", "tests")


def files(*folders: str) -> list[Path]:
    """All Python files under the folders of the checkout; servod/drivers is a link and counts once."""
    found = [f for folder in folders or FOLDERS for f in sorted((ROOT / folder).rglob("*.py"))]
    return [f for f in found if "__pycache__" not in f.parts and (ROOT / "servod/drivers") not in f.parents]


@cache
def tree(file: Path) -> ast.Module:
    """The file's syntax tree."""
    return ast.parse(file.read_text(encoding="utf-8"))


def module_name(file: Path) -> str:
    """The dotted name under which a file of servod/ or drivers/ is imported."""
    parts = list(file.relative_to(ROOT).with_suffix("").parts)
    if parts[0] == "drivers":
        parts.insert(0, "servod")
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imports(file: Path) -> Iterator[tuple[str, int]]:
    """Every module that the file imports anywhere in it, with the line; names taken from a package count as modules."""
    for node in ast.walk(tree(file)):
        if isinstance(node, ast.Import):
            yield from ((alias.name, node.lineno) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.module, node.lineno
            yield from ((f"{node.module}.{alias.name}", node.lineno) for alias in node.names)


def top_imports(file: Path) -> Iterator[tuple[str, int]]:
    """As `imports`, but only what is imported when the file is."""
    lines = {n.lineno for n in tree(file).body if isinstance(n, ast.Import | ast.ImportFrom)}
    yield from ((name, line) for name, line in imports(file) if line in lines)
