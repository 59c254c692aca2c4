"""Builds one self-contained HTML page: the verdict, by what and from what it was made, then sentences, tables, figures.

Behind everything; called by verbs that report. Style and script are page.css and page.js, and stand in the file: it
opens without a network. Needs the lab part.
"""

from __future__ import annotations

import base64
import datetime
import hashlib
import html
import json
import platform
import re
import shutil
import subprocess
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import servod
from servod.common.files import write_bytes
from servod.formats.config import AxisConfig
from servod.lab.report.figure import Array, Curve, Figure, PageTable, PlotAxis, PlotPanel, ScaleKind, Style

_HERE = Path(__file__).parent
#: What is aligned as a number.
_NUMBER = re.compile(r"[-+−–<≤≥]? ?\d|[-–]$")
_TEXT = ' class="text"'
#: Letters from which a cell is not squeezed to a word a line; rows up to which a table is not parted on paper.
_LONG, _SHORT_TABLE = 30, 15
#: Digits of a hash that are shown; all of them stand under the pointer.
_SHORT = 12


class Verdict(NamedTuple):
    """The answer in one sentence, with the figures that decide; `passed` is None where nothing was judged."""

    text: str
    passed: bool | None = None

    def html(self) -> str:
        """The first paragraph of the page."""
        kind = {True: "passed", False: "failed", None: "told"}[self.passed]
        word = {True: "Passed: ", False: "Refused: ", None: ""}[self.passed]
        return f'<p id="verdict" class="{kind}">{html.escape(word + self.text)}</p>'


@dataclass(frozen=True)
class Origin:
    """What a report was made from: files by what they are, and the axis whose drives it is about.

    Files are hashed when the page is made; one that is not there (any more) is left out. `nodes` are those of the
    daemon's status, with the identity that each told; without them the configuration's counts. `facts` are further
    lines by their names.
    """

    files: Mapping[str, Path | Sequence[Path]] = field(default_factory=dict)
    axis: AxisConfig | None = None
    nodes: Sequence[Mapping[str, Any]] = ()
    facts: Mapping[str, str] = field(default_factory=dict)


class Page:
    """A page in the making; parts appear in the order in which they were added, verdict and signature before them."""

    def __init__(self, title: str, verdict: Verdict, origin: Origin | None = None) -> None:
        self._title, self._verdict, self._origin = title, verdict, origin or Origin()
        self._parts: list[str] = []
        self._heading = ""
        self._figures: list[Figure] = []

    def heading(self, text: str) -> None:
        """Begin a section."""
        self._heading = text
        self._parts.append(f"<h2>{html.escape(text)}</h2>")

    def sentence(self, text: str) -> None:
        """Add a paragraph of plain text."""
        self._parts.append(f"<p>{html.escape(text)}</p>")

    def points(self, lines: Sequence[str]) -> None:
        """Add a list of plain sentences."""
        if lines:
            self._parts.append("<ul>" + "".join(f"<li>{html.escape(line)}</li>" for line in lines) + "</ul>")

    def folded(self, title: str, lines: Sequence[str]) -> None:
        """Add paragraphs that are shown when their title is clicked: mathematics, and what few readers need."""
        inner = "".join(f"<p>{html.escape(line)}</p>" for line in lines)
        self._parts.append(f"<details><summary>{html.escape(title)}</summary>{inner}</details>")

    def table(self, table: PageTable, folded: bool = False) -> None:
        """Add a table; a `folded` one is shown when its title is clicked. Without rows nothing is added."""
        if table.rows:
            shown = table_html(table, caption=not folded and table.title != self._heading)
            title = html.escape(table.title)
            self._parts.append(f"<details><summary>{title}</summary>{shown}</details>" if folded else shown)

    def html_part(self, text: str) -> None:
        """Add HTML as it is."""
        self._parts.append(text)

    def figure(self, figure: Figure) -> None:
        """Add a figure with its caption; every row of its curves is kept in the page. Names are unique in a page."""
        self._figures.append(figure)
        self._parts.append(figure_html(figure))

    def html(self) -> str:
        """The whole page."""
        title, style = html.escape(self._title), (_HERE / "page.css").read_text()
        return (
            f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
            '<meta name="viewport" content="width=device-width, initial-scale=1">'
            f"<style>{style}{_running_head(self._title)}</style></head>\n<body>\n"
            f'<header><h1 id="title">{title}</h1>{self._verdict.html()}{signature(self._origin)}</header>\n<main>\n'
            + "\n".join(self._parts)
            + f"\n</main>\n<footer>servod {servod.__version__}</footer>\n{self._drawing()}</body></html>\n"
        )

    def _drawing(self) -> str:
        """The script, which unfolds what is printed, and the rows that it draws."""
        script = f"<script>{(_HERE / 'page.js').read_text()}</script>\n"
        if not self._figures:
            return script
        rows = json.dumps(PageData(self._figures).document(), allow_nan=False).replace("<", "\\u003c")
        return (
            "<noscript><p>The pictures of this page are drawn by its script, which is switched off here.</p></noscript>"
            f'<script type="application/json" id="page-data">{rows}</script>'
            f"{script}"
        )

    def write(self, path: Path) -> None:
        """Write the page aside and rename it to `path`. Raises BadInput when that is not possible."""
        write_bytes(path, self.html().encode())


def table_html(table: PageTable, caption: bool = True, shades: Sequence[Sequence[int]] | None = None) -> str:
    """A table that scrolls in a box of its own where it is wider than the page; a row that failed says so.

    `shades` colours its cells, first column left out, from 0 (not at all) to 3.
    """
    text = [_is_text([cell for cell in column if cell]) for column in zip(*table.rows, strict=True)]
    lines = []
    for index, (first, *rest) in enumerate(table.rows):
        looks = [_look(words, cell) for words, cell in zip(text[1:], rest, strict=True)]
        if shades:
            looks = [f' class="share{shade}"' if shade else "" for shade in shades[index]]
        cells = "".join(f"<td{look}>{html.escape(cell)}</td>" for look, cell in zip(looks, rest, strict=True))
        failed = ' class="failed"' if "failed" in rest else ""
        lines.append(f'<tr{failed}><th scope="row">{html.escape(first)}</th>{cells}</tr>')
    head = "".join(
        f'<th scope="col"{_TEXT if words else ""}>{html.escape(cell)}</th>'
        for cell, words in zip(table.header, text, strict=True)
    )
    title, kind = html.escape(table.title or table.header[0]), ' class="cells"' if shades else ""
    short = " short" if len(table.rows) <= _SHORT_TABLE else ""
    above = f"<caption>{html.escape(table.title)}</caption>" if caption and table.title else ""
    return (
        f'<div class="scroll{short}" role="region" tabindex="0" aria-label="Table: {title}"><table{kind}>{above}'
        f"<thead><tr>{head}</tr></thead><tbody>{''.join(lines)}</tbody></table></div>"
    )


def _look(words: bool, cell: str) -> str:
    """The class of a cell."""
    return ' class="text long"' if words and len(cell) > _LONG else _TEXT if words else ""


def _is_text(cells: Sequence[str]) -> bool:
    """Whether a column is aligned as text: most of its cells are no numbers."""
    told = [cell for cell in cells if cell not in ("", "-", "–")]
    return sum(_NUMBER.match(cell) is None for cell in told) > len(told) / 2


def _running_head(title: str) -> str:
    """Title and page number on every sheet of paper."""
    text = "".join(c for c in title if c.isprintable() and c not in '"\\<')
    look = "font: 8pt system-ui, sans-serif; color: #444;"
    return (
        f'@page {{ @top-left {{ content: "{text}"; {look} }} '
        f'@bottom-right {{ content: counter(page) " of " counter(pages); {look} }} }}'
    )


# --- The signature ---------------------------------------------------------------------------------------------------
# Who made a page, when, on what and from what: what one wants to know before one signs it.


def signature(origin: Origin) -> str:
    """The block below the verdict."""
    now = datetime.datetime.now().astimezone()
    utc = now.astimezone(datetime.UTC)
    local = now.strftime("%Y-%m-%d %H:%M:%S %z")
    rows = [
        ("date", html.escape(f"{utc:%Y-%m-%d %H:%M:%S} UTC (here {local[:-2]}:{local[-2:]})")),
        ("host", html.escape(f"{platform.node()}, {platform.machine()}")),
        ("servod", html.escape(f"{servod.__version__}{_commit()}")),
        ("Python", html.escape(f"{platform.python_version()}, numpy {np.__version__}")),
        ("kernel", html.escape(f"{platform.system()} {platform.release()}")),
        *((html.escape(name), html.escape(fact)) for name, fact in origin.facts.items()),
        *(("drive", html.escape(line)) for line in drives(origin)),
        *(("file", line) for line in _files(origin)),
    ]
    inner = "".join(f"<dt>{name}</dt><dd>{value}</dd>" for name, value in rows)
    return f'<section id="signature" aria-label="Signature"><dl>{inner}</dl></section>'


def drives(origin: Origin) -> list[str]:
    """Each node with its identity (0x1018): as it told it, or as the configuration has it checked at the start."""
    nodes, axis = origin.nodes, origin.axis
    if not nodes and axis is not None:
        pairs = (("amplifier", axis.amplifier), ("encoder", axis.encoder))
        nodes = [{"role": role, **node.model_dump(include={"node_id", "driver", "identity"})} for role, node in pairs]
    return [_drive(node) for node in nodes]


def _drive(node: Mapping[str, Any]) -> str:
    told = {name: value for name, value in (node.get("identity") or {}).items() if value is not None}
    shown = (
        f"{name.replace('_id', '').replace('_code', '')} {value if name == 'serial' else hex(value)}"
        for name, value in told.items()
    )
    known = ", ".join(shown) or "identity not stated"
    return f"{node['role']}, node {node['node_id']}, driver {node['driver']}: {known}"


def _files(origin: Origin) -> list[str]:
    """Each file with its hash; of a list one line with the hash over all of them."""
    lines = []
    for what, given in origin.files.items():
        files = [file for file in ([given] if isinstance(given, Path) else given) if file.is_file()]
        if not files:
            continue
        hashes = [hashlib.sha256(file.read_bytes()).hexdigest() for file in files]
        if len(files) == 1:
            lines.append(f"{html.escape(f'{what}: {files[0].name}')} {_hash(hashes[0])}")
            continue
        each = "".join(f"<div>{html.escape(f.name)} {_hash(h)}</div>" for f, h in zip(files, hashes, strict=True))
        whole = hashlib.sha256("".join(hashes).encode()).hexdigest()
        title = f"{html.escape(what)}: {len(files)} files {_hash(whole)}"
        lines.append(f"<details><summary>{title}</summary>{each}</details>")
    return lines


def _hash(sha256: str) -> str:
    return f'<code class="hash" title="SHA-256 {sha256}">{sha256[:_SHORT]}</code>'


def _commit() -> str:
    """The commit of a checkout, with a mark where files differ from it; nothing for an installed package."""
    tree, git = Path(servod.__file__).parents[1], shutil.which("git")
    if git is None or not (tree / ".git").exists():
        return ""
    asked = [git, "-C", str(tree), "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"]
    try:
        found = subprocess.run(asked, capture_output=True, text=True, timeout=5.0, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return f", git {found.stdout.strip()}" if found.returncode == 0 and found.stdout.strip() else ""


# --- Figures ---------------------------------------------------------------------------------------------------------
# The HTML around the panels of a figure, and every row of its curves for page.js to draw. Each series is kept once
# however many curves show it, up to MOST_BYTES a page; of what is longer lowest and highest row of equal bins.


#: Rows that a page keeps of a curve: ten minutes at 1 kHz. And of all its curves, four bytes each before deflating.
MOST_ROWS, MOST_BYTES = 600_000, 24_000_000
#: Of a series that is thinned to fit into MOST_BYTES at least so many rows stay.
_LEAST_ROWS = 4000
#: Times that differ from an even grid by less than this share of a step are that grid.
_EVEN = 1e-3
#: Rows of panels up to which a figure stands whole on a sheet of paper.
_SHORT_ROWS = 3.0
_TOOLS = (
    *(("in", "+", "Zoom in"), ("out", "−", "Zoom out"), ("left", "←", "Earlier"), ("right", "→", "Later")),
    ("all", "all", "Show all"),
)
_DASHES = {Style.DASHED: "7 4", Style.DOTTED: "2 3"}


class PageData:
    """What page.js draws from: series of numbers, and figures that name them by their place."""

    def __init__(self, figures: Sequence[Figure]) -> None:
        self._arrays: list[dict[str, Any]] = []
        self._places: dict[bytes, int] = {}
        lengths = {id(c.y): len(c.y) for f in figures for p in f.panels for c in p.curves}
        self.most_rows = _most_rows(list(lengths.values()))
        self._figures = [self._figure(figure) for figure in figures]

    def document(self) -> dict[str, Any]:
        """Plain values for the page."""
        return {"arrays": self._arrays, "figures": self._figures}

    def _figure(self, figure: Figure) -> dict[str, Any]:
        panels = [
            {
                "title": p.title,
                "x": _scale(p.x),
                "y": _scale(p.y),
                "curves": [self._curve(c, p) for c in p.curves],
            }
            for p in figure.panels
        ]
        return {"name": figure.name, "columns": figure.columns, "row_height": figure.row_height, "panels": panels}

    def _curve(self, curve: Curve, panel: PlotPanel) -> dict[str, Any]:
        held = {"label": curve.label, "detail": curve.detail, "colour": curve.colour.name.lower()}
        held |= {"style": curve.style.value, "width": curve.width}  # type: ignore[dict-item]
        x, y = at_most(curve.x, curve.y, self.most_rows)
        places: dict[str, Any] = {"x": self._series(x, precise=True), "y": self._series(y)}
        if curve.bounds is not None:
            places |= {"low": self._series(curve.bounds[0]), "high": self._series(curve.bounds[1])}
        return held | places

    def _series(self, values: Array, precise: bool = False) -> int:
        packed = packed_series(values, precise)
        key = repr(sorted(packed.items())).encode()
        if key not in self._places:
            self._places[key] = len(self._arrays)
            self._arrays.append(packed)
        return self._places[key]


def packed_series(values: Array, precise: bool = False) -> dict[str, Any]:
    """A series as the page keeps it: an even grid by its numbers, others as bytes by their place in a float, deflated.

    `precise` keeps eight bytes of each value, where four would make steps of a long time.
    """
    if precise and len(values) > 1:
        step = (values[-1] - values[0]) / (len(values) - 1)
        even = values[0] + step * np.arange(len(values))
        if step > 0.0 and float(np.abs(values - even).max()) < _EVEN * step:
            return {"n": len(values), "from": float(values[0]), "step": float(step)}
    kind, size = ("f8", 8) if precise else ("f4", 4)
    raw = np.ascontiguousarray(values, dtype=f"<{kind}").view(np.uint8).reshape(-1, size)
    return {"kind": kind, "z": base64.b64encode(zlib.compress(raw.T.tobytes(), 6)).decode()}


def at_most(x: Array, y: Array, most: int) -> tuple[Array, Array]:
    """A curve that is longer than `most` as lowest and highest row of equal bins."""
    if len(y) <= most:
        return x, y
    width = -(-len(y) // (most // 2))
    whole = len(y) // width * width
    begins = np.arange(0, whole, width)
    bins = y[:whole].reshape(-1, width)
    kept = np.unique(np.concatenate([begins + bins.argmin(axis=1), begins + bins.argmax(axis=1), [len(y) - 1]]))
    return x[kept], y[kept]


def _most_rows(lengths: list[int]) -> int:
    """The longest that a curve may be so that all of them together keep MOST_BYTES."""
    most = MOST_ROWS
    while most > _LEAST_ROWS and sum(4 * min(length, most) for length in lengths) > MOST_BYTES:
        most = max(most * 4 // 5, _LEAST_ROWS)
    return most


def _scale(axis: PlotAxis) -> dict[str, Any]:
    scale: dict[str, Any] = {"label": axis.label, "log": axis.scale is ScaleKind.LOG}
    if axis.span is not None:
        scale["span"] = [float(end) for end in axis.span]
    if axis.names:
        scale["names"] = list(axis.names)
    return scale


def figure_html(figure: Figure) -> str:
    """The figure without its curves: title, legend, tools, a place for each panel, caption."""
    name = html.escape(figure.name)
    panels = "".join(_panel_html(panel, k) for k, panel in enumerate(figure.panels))
    tools = "".join(
        f'<button type="button" data-act="{act}" aria-label="{says}">{sign}</button>' for act, sign, says in _TOOLS
    )
    short = ' class="short"' if figure.rows * figure.row_height <= _SHORT_ROWS else ""
    caption = f"<figcaption>{html.escape(figure.caption)}</figcaption>" if figure.caption else ""
    return (
        f'<figure id="figure-{name}"{short} data-figure="{name}" aria-label="{html.escape(figure.title)}">'
        f'<p class="figure-title">{html.escape(figure.title)}</p>'
        f'<div class="controls"><div class="legend">{_legend(figure)}</div><div class="tools">{tools}</div></div>'
        f'<div class="panels">{panels}</div>{caption}</figure>'
    )


def _legend(figure: Figure) -> str:
    """A button for each label; one alone needs no legend."""
    first: dict[str, Curve] = {}
    for shown in (c for panel in figure.panels for c in panel.curves if c.label):
        first.setdefault(shown.label, shown)
    if len(first) < 2:
        return ""
    return "".join(
        f'<button type="button" aria-pressed="true">{_sample(curve)}{html.escape(label)}</button>'
        for label, curve in first.items()
    )


def _sample(curve: Curve) -> str:
    """How a curve looks, in small."""
    colour = f"var(--{curve.colour.name.lower()})"
    if curve.style is Style.POINTS:
        mark = f'<circle cx="11" cy="6" r="3.5" fill="{colour}"/>'
    elif curve.style is Style.BARS:
        mark = f'<rect width="22" height="9" y="1.5" fill="{colour}"/>'
    else:
        dash = f' stroke-dasharray="{_DASHES[curve.style]}"' if curve.style in _DASHES else ""
        mark = f'<path d="M0 6H22" stroke="{colour}" stroke-width="2.5"{dash}/>'
    return f'<svg width="22" height="12" aria-hidden="true">{mark}</svg>'


def _panel_html(panel: PlotPanel, number: int) -> str:
    title = f"<b>{html.escape(panel.title)}</b>" if panel.title else ""
    drawn = ", ".join(dict.fromkeys(c.label for c in panel.curves if c.label)) or "curves"
    over = " over ".join(filter(None, (panel.y.label or "states", panel.x.label)))
    says = html.escape(f"{panel.title + ': ' if panel.title else ''}{over}: {drawn}")
    return (
        f'<div class="panel" data-panel="{number}" role="group" tabindex="0" aria-label="{says}. '
        'Plus and minus zoom, arrows move, 0 shows all.">'
        f'<p class="panel-head">{title}{html.escape(panel.y.label)}<span class="y-factor"></span></p>'
        f'<svg role="img" aria-label="{says}"></svg>'
        f'<p class="panel-foot">{html.escape(panel.x.label)}<span class="x-factor"></span></p>'
        '<div class="readout" hidden></div></div>'
    )
