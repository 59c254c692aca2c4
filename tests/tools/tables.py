"""Text from the code as Markdown: tables, defaults, and prose without what Markdown takes for markup."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

_MARKUP = re.compile(r"([\\*_<>\[\]{}$#~])")


def markdown(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def code(default: str) -> str:
    """A default as it would stand in the file; not of a key that has none."""
    return default if default in ("", "required") else f"`{default}`"


def prose(text: str) -> str:
    """A docstring or a help text in one paragraph: what stands between backquotes is code, all else is plain."""
    parts = re.split(r"(`[^`]*`)", " ".join(text.split()))
    return "".join(part if part.startswith("`") else _MARKUP.sub(r"\\\1", part) for part in parts)
