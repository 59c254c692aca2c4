"""Builds one self-contained HTML page: sentences, tables and plotly figures, with the plotting code inside the file.

Behind everything; called by verbs that report. Needs plotly (the lab part).
"""

from __future__ import annotations

import html
from collections.abc import Sequence
from pathlib import Path

import plotly.graph_objects as go
import plotly.io
from plotly.offline import get_plotlyjs

from servod import __version__
from servod.common.files import write_bytes
from servod.lab.report.figure import Figure
from servod.lab.report.page_figure import HEAD_PX, every_row_script, plotly_figure

_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 70rem; margin: 2rem auto; padding: 0 1rem; color: #222; }
h1 { font-size: 1.6rem; } h2 { font-size: 1.2rem; margin-top: 2.5rem; }
table { border-collapse: collapse; } th, td { padding: .3rem .9rem; text-align: right; border-bottom: 1px solid #ddd; }
th:first-child, td:first-child { text-align: left; } table { margin: 1rem 0; }
.lead { font-size: 1.25rem; font-weight: 600; border-left: 4px solid #0072b2;
  padding-left: .8rem; }
details { margin: .8rem 0; } summary { cursor: pointer; color: #0072b2; } details p { margin: .4rem 1.2rem; }
footer { margin-top: 3rem; color: #777; font-size: .85rem; }
"""


class Page:
    """A page in the making; parts appear in the order in which they were added."""

    def __init__(self, title: str) -> None:
        self._title = title
        self._parts = [f"<h1>{html.escape(title)}</h1>"]
        self._has_figure = False

    def heading(self, text: str) -> None:
        """Begin a section."""
        self._parts.append(f"<h2>{html.escape(text)}</h2>")

    def sentence(self, text: str) -> None:
        """Add a paragraph of plain text."""
        self._parts.append(f"<p>{html.escape(text)}</p>")

    def lead(self, text: str) -> None:
        """Add a paragraph that stands out: the answer in one sentence."""
        self._parts.append(f'<p class="lead">{html.escape(text)}</p>')

    def points(self, lines: Sequence[str]) -> None:
        """Add a list of plain sentences."""
        self._parts.append("<ul>" + "".join(f"<li>{html.escape(line)}</li>" for line in lines) + "</ul>")

    def folded(self, title: str, lines: Sequence[str]) -> None:
        """Add paragraphs that are shown when their title is clicked: mathematics, and what few readers need."""
        inner = "".join(f"<p>{html.escape(line)}</p>" for line in lines)
        self._parts.append(f"<details><summary>{html.escape(title)}</summary>{inner}</details>")

    def table(self, header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
        """Add a table; cells are plain text."""
        head = "".join(f"<th>{html.escape(cell)}</th>" for cell in header)
        body = "".join("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
        self._parts.append(f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>")

    def figure(self, figure: Figure | go.Figure, every_row: bool = False) -> None:
        """Add a figure, of this project or of plotly; the caption of the former stands below it.

        With `every_row` the page holds a figure of this project as it is, and draws what is zoomed into from that.
        """
        self._has_figure = True
        drawn = plotly_figure(figure) if isinstance(figure, Figure) else figure
        if every_row:
            drawn.update_xaxes(matches="x")
        top = HEAD_PX if isinstance(figure, Figure) else 75
        drawn.update_layout(template="plotly_white", margin={"l": 70, "r": 20, "t": top, "b": 50})
        self._parts.append(
            plotly.io.to_html(
                drawn,
                full_html=False,
                include_plotlyjs=False,
                config={"displaylogo": False},
                post_script=every_row_script(figure) if every_row and isinstance(figure, Figure) else None,
            )
        )
        if isinstance(figure, Figure) and figure.caption:
            self.sentence(figure.caption)

    def html(self) -> str:
        """The whole page; plotly's own code stands in it once, so that it opens without a network."""
        script = f"<script>{get_plotlyjs()}</script>" if self._has_figure else ""
        return (
            f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{html.escape(self._title)}</title>'
            f"<style>{_STYLE}</style>{script}</head>\n<body>\n" + "\n".join(self._parts) + "\n"
            f"<footer>servod {__version__}</footer>\n</body></html>\n"
        )

    def write(self, path: Path) -> None:
        """Write the page aside and rename it to `path`. Raises BadInput when that is not possible."""
        write_bytes(path, self.html().encode())
