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
import time
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import servod
from servod.common.errors import visible
from servod.common.files import write_bytes
from servod.common.units import NS_PER_S
from servod.formats.config import AxisConfig
from servod.formats.recording.mcap_reader import recorded_at_ns
from servod.lab.report.figure import Array, Curve, Figure, PageTable, PlotAxis, PlotPanel, ScaleKind, Style, extremes

_HERE = Path(__file__).parent
#: What is aligned as a number.
_NUMBER = re.compile(r"[-+−–<≤≥]? ?\d|[-–]$")
_TEXT = ' class="text"'
#: Letters from which a cell is not squeezed to a word a line; rows up to which a table is not parted on paper.
_LONG, _SHORT_TABLE = 30, 15
#: What an origin calls the recordings that its page is about.
_RECORDINGS = ("recording", "recordings")


def _text(words: str) -> str:
    """Words as HTML, whatever they hold."""
    return html.escape(visible(words))


class Verdict(NamedTuple):
    """The answer in one sentence, with the figures that decide; `passed` is None where nothing was judged."""

    text: str
    passed: bool | None = None

    def html(self) -> str:
        """The first paragraph of the page."""
        kind = {True: "passed", False: "failed", None: "told"}[self.passed]
        word = {True: "Passed: ", False: "Refused: ", None: ""}[self.passed]
        return f'<p id="verdict" class="{kind}">{_text(word + self.text)}</p>'


@dataclass(frozen=True)
class Origin:
    """What a report was made from: files by what they are, and the axis whose drives it is about.

    Files are hashed when this is made, right after they were read, unless their reader has told their `sha256`; one
    that is not there is left out. `nodes` are those of the daemon's status, with the identity that each told; without
    them the configuration's counts. `facts` are further lines by their names. Files that it calls "recording" or
    "recordings" tell themselves when that was; `recorded_ns` does so for cycles that stand in no file (time of day of
    the first, ns since 1970).
    """

    files: Mapping[str, Path | Sequence[Path]] = field(default_factory=dict)
    axis: AxisConfig | None = None
    nodes: Sequence[Mapping[str, Any]] = ()
    facts: Mapping[str, str] = field(default_factory=dict)
    recorded_ns: int | None = None
    sha256: Mapping[Path, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        files = {file for name in self.files for file in self.given(name)} - set(self.sha256)
        now = {file: hashlib.sha256(file.read_bytes()).hexdigest() for file in files if file.is_file()}
        object.__setattr__(self, "sha256", {**now, **self.sha256})

    def given(self, name: str) -> list[Path]:
        """The files of a name, as a list."""
        found = self.files.get(name, ())
        return [found] if isinstance(found, Path) else list(found)


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
        self._parts.append(f"<h2>{_text(text)}</h2>")

    def sentence(self, text: str) -> None:
        """Add a paragraph of plain text."""
        self._parts.append(f"<p>{_text(text)}</p>")

    def points(self, lines: Sequence[str]) -> None:
        """Add a list of plain sentences."""
        if lines:
            self._parts.append("<ul>" + "".join(f"<li>{_text(line)}</li>" for line in lines) + "</ul>")

    def folded(self, title: str, lines: Sequence[str]) -> None:
        """Add paragraphs that are shown when their title is clicked: mathematics, and what few readers need."""
        inner = "".join(f"<p>{_text(line)}</p>" for line in lines)
        self._parts.append(f"<details><summary>{_text(title)}</summary>{inner}</details>")

    def table(self, table: PageTable, folded: bool = False) -> None:
        """Add a table; a `folded` one is shown when its title is clicked. Without rows nothing is added."""
        if table.rows:
            shown = table_html(table, caption=not folded and table.title != self._heading)
            title = _text(table.title)
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
        title, style = _text(self._title), (_HERE / "page.css").read_text(encoding="utf-8")
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
        script = f"<script>{(_HERE / 'page.js').read_text(encoding='utf-8')}</script>\n"
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
        cells = "".join(f"<td{look}>{_text(cell)}</td>" for look, cell in zip(looks, rest, strict=True))
        failed = ' class="failed"' if "failed" in rest else ""
        lines.append(f'<tr{failed}><th scope="row">{_text(first)}</th>{cells}</tr>')
    head = "".join(
        f'<th scope="col"{_TEXT if words else ""}>{_text(cell)}</th>'
        for cell, words in zip(table.header, text, strict=True)
    )
    title, kind = _text(table.title or table.header[0]), ' class="cells"' if shades else ""
    short = " short" if len(table.rows) <= _SHORT_TABLE else ""
    above = f"<caption>{_text(table.title)}</caption>" if caption and table.title else ""
    return (
        f'<div class="scroll{short}" role="region" tabindex="0" aria-label="Table: {title}"><table{kind}>{above}'
        f"<thead><tr>{head}</tr></thead><tbody>{''.join(lines)}</tbody></table></div>"
    )


def _look(words: bool, cell: str) -> str:
    """The class of a cell."""
    return ' class="text long"' if words and len(cell) > _LONG else _TEXT if words else ""


def _is_text(cells: Sequence[str]) -> bool:
    """Whether a column is aligned as text: most of its cells are no numbers."""
    filled = [cell for cell in cells if cell not in ("", "-", "–")]
    return sum(_NUMBER.match(cell) is None for cell in filled) > len(filled) / 2


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
    rows = [
        ("drawn", _text(_time_of_day(time.time_ns()))),
        *(("recorded", _text(line)) for line in _recorded(origin)),
        ("host", _text(f"{platform.node()}, {platform.machine()}")),
        ("servod", _text(f"{servod.__version__}{_commit()}")),
        ("Python", _text(f"{platform.python_version()}, numpy {np.__version__}")),
        ("kernel", _text(f"{platform.system()} {platform.release()}")),
        *((_text(name), _text(fact)) for name, fact in origin.facts.items()),
        *(("drive", _text(line)) for line in drives(origin)),
        *(("file", line) for line in _files(origin)),
    ]
    inner = "".join(f"<dt>{name}</dt><dd>{value}</dd>" for name, value in rows)
    return f'<section id="signature" aria-label="Signature"><dl>{inner}</dl></section>'


def _time_of_day(time_ns: int) -> str:
    """A time in UTC, and as the clock on this machine's wall shows it."""
    utc = datetime.datetime.fromtimestamp(time_ns // NS_PER_S, datetime.UTC)
    local = utc.astimezone().strftime("%Y-%m-%d %H:%M:%S %z")
    return f"{utc:%Y-%m-%d %H:%M:%S} UTC (here {local[:-2]}:{local[-2:]})"


def _recorded(origin: Origin) -> list[str]:
    """When the recordings that the page is about began, first and last; a page without recordings has no such line."""
    if origin.recorded_ns is not None:
        return [_time_of_day(origin.recorded_ns)]
    files = [file for name in _RECORDINGS for file in origin.given(name) if file.is_file()]
    times_ns = sorted(at for file in files if (at := recorded_at_ns(file)) is not None)
    if not times_ns:
        return ["not told: no time of day stands in the files"] if files else []
    first, last = _time_of_day(times_ns[0]), _time_of_day(times_ns[-1])
    return [first if len(files) == 1 else f"{first} to {last}, {len(times_ns)} of {len(files)} files tell it"]


def drives(origin: Origin) -> list[str]:
    """Each node with its identity (0x1018): as it told it, or as the configuration has it checked at the start."""
    nodes, axis = origin.nodes, origin.axis
    if not nodes and axis is not None:
        pairs = (("amplifier", axis.amplifier), ("encoder", axis.encoder))
        nodes = [{"role": role, **node.model_dump(include={"node_id", "driver", "identity"})} for role, node in pairs]
    return [_drive(node) for node in nodes]


def _drive(node: Mapping[str, Any]) -> str:
    identity = {name: value for name, value in (node.get("identity") or {}).items() if value is not None}
    shown = (
        f"{name.replace('_id', '').replace('_code', '')} {value if name == 'serial' else hex(value)}"
        for name, value in identity.items()
    )
    known = ", ".join(shown) or "identity not stated"
    return f"{node['role']}, node {node['node_id']}, driver {node['driver']}: {known}"


def _files(origin: Origin) -> list[str]:
    """Each file with its hash; of a list one line with the hash over all of them."""
    lines = []
    for what in origin.files:
        files = [file for file in origin.given(what) if file in origin.sha256]
        if not files:
            continue
        hashes = [origin.sha256[file] for file in files]
        if len(files) == 1:
            lines.append(f"<bdi>{_text(f'{what}: {files[0].name}')}</bdi> {_hash(hashes[0])}")
            continue
        named = zip(files, hashes, strict=True)
        each = "".join(f"<div><bdi>{_text(file.name)}</bdi> {_hash(one)}</div>" for file, one in named)
        whole = hashlib.sha256("".join(hashes).encode()).hexdigest()
        title = f"{_text(what)}: {len(files)} files {_hash(whole)}"
        lines.append(f"<details><summary>{title}</summary>{each}</details>")
    return lines


def _hash(sha256: str) -> str:
    return f'<code class="hash" dir="ltr" title="SHA-256">{sha256}</code>'


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
#: Share of its usual step that a value may lose when it is kept in four bytes.
_LOST = 1e-2
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
        self._indices: dict[bytes, int] = {}
        shown = [y for f in figures for p in f.panels for c in p.curves for y in (c.y, *(c.bounds or ()))]
        self.most_rows = _most_rows([(len(y), _bytes_each(y)) for y in {id(y): y for y in shown}.values()])
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
        return {
            "name": visible(figure.name),
            "columns": figure.columns,
            "row_height": figure.row_height,
            "panels": panels,
        }

    def _curve(self, curve: Curve, panel: PlotPanel) -> dict[str, Any]:
        held = {"label": curve.label, "detail": curve.detail, "colour": curve.colour.name.lower()}
        held |= {"style": curve.style.value, "width": curve.width}  # type: ignore[dict-item]
        kept = extremes(curve.y, self.most_rows)
        indices: dict[str, Any] = {"x": self._series(curve.x[kept], precise=True), "y": self._series(curve.y[kept])}
        if curve.bounds is not None:
            indices |= {key: self._series(y[kept]) for key, y in zip(("low", "high"), curve.bounds, strict=True)}
        return held | indices

    def _series(self, values: Array, precise: bool = False) -> int:
        packed = packed_series(values, precise)
        key = repr(sorted(packed.items())).encode()
        if key not in self._indices:
            self._indices[key] = len(self._arrays)
            self._arrays.append(packed)
        return self._indices[key]


def packed_series(values: Array, precise: bool = False) -> dict[str, Any]:
    """A series as the page keeps it: an even grid by its numbers, others as bytes by their place in a float, deflated.

    Eight bytes of each value where four would make steps of what is smooth; `precise`: of all but an even grid.
    """
    if precise and len(values) > 1:
        step = (values[-1] - values[0]) / (len(values) - 1)
        even = values[0] + step * np.arange(len(values))
        if step > 0.0 and float(np.abs(values - even).max()) < _EVEN * step:
            return {"n": len(values), "from": float(values[0]), "step": float(step)}
    size = 8 if precise else _bytes_each(values)
    raw = np.ascontiguousarray(values, dtype=f"<f{size}").view(np.uint8).reshape(-1, size)
    return {"kind": f"f{size}", "z": base64.b64encode(zlib.compress(raw.T.tobytes(), 6)).decode()}


def _bytes_each(values: Array) -> int:
    """Four where that loses little of the usual step from row to row: far from zero it would lose the step itself."""
    known = values[np.isfinite(values)]
    steps = np.abs(np.diff(known))
    with np.errstate(over="ignore"):
        lost = np.abs(known - known.astype(np.float32))
    return 4 if not steps.any() or lost.max() <= _LOST * np.median(steps[steps > 0.0]) else 8


def _most_rows(sizes: list[tuple[int, int]]) -> int:
    """The longest that a curve may be so that all of them, by length and bytes of each value, keep MOST_BYTES."""
    most = MOST_ROWS
    while most > _LEAST_ROWS and sum(size * min(length, most) for length, size in sizes) > MOST_BYTES:
        most = max(most * 4 // 5, _LEAST_ROWS)
    return most


def _scale(axis: PlotAxis) -> dict[str, Any]:
    scale: dict[str, Any] = {"label": axis.label, "log": axis.scale is ScaleKind.LOG}
    if axis.span is not None:
        scale["span"] = [float(end) for end in axis.span]
    if axis.names:
        scale["names"] = [visible(name) for name in axis.names]
    return scale


def figure_html(figure: Figure) -> str:
    """The figure without its curves: title, legend, tools, a place for each panel, caption."""
    name = _text(figure.name)
    panels = "".join(_panel_html(panel, k) for k, panel in enumerate(figure.panels))
    tools = "".join(
        f'<button type="button" data-act="{act}" aria-label="{says}">{sign}</button>' for act, sign, says in _TOOLS
    )
    short = ' class="short"' if figure.rows * figure.row_height <= _SHORT_ROWS else ""
    caption = f"<figcaption>{_text(figure.caption)}</figcaption>" if figure.caption else ""
    return (
        f'<figure id="figure-{name}"{short} data-figure="{name}" aria-label="{_text(figure.title)}">'
        f'<p class="figure-title">{_text(figure.title)}</p>'
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
        f'<button type="button" aria-pressed="true">{_sample(curve)}{_text(label)}</button>'
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
    title = f"<b>{_text(panel.title)}</b>" if panel.title else ""
    drawn = ", ".join(dict.fromkeys(c.label for c in panel.curves if c.label)) or "curves"
    over = " over ".join(filter(None, (panel.y.label or "states", panel.x.label)))
    says = _text(f"{panel.title + ': ' if panel.title else ''}{over}: {drawn}")
    return (
        f'<div class="panel" data-panel="{number}" role="group" tabindex="0" aria-label="{says}. '
        'Plus and minus zoom, arrows move, 0 shows all.">'
        f'<p class="panel-head">{title}{_text(panel.y.label)}<span class="y-factor"></span></p>'
        f'<svg role="img" aria-label="{says}"></svg>'
        f'<p class="panel-foot">{_text(panel.x.label)}<span class="x-factor"></span></p>'
        '<div class="readout" hidden></div></div>'
    )
