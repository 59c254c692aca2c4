"""Zooms into reports with the mouse: what is drawn is what was recorded, and pictures over the same time move together.

Stands on what the script of a page offers (`servodFigures`) for reading alone; the hand is a real one.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from playwright.sync_api import Browser, Page

from tests.browser.reports import RATE_HZ, SINE_HZ, SINE_RAD

#: What is zoomed to, s: four periods of the sine. Each must be drawn by so many points, which miss it by so little.
NEAR_S, LEAST_POINTS, MOST_MISSED = 0.2, 40, 1e-3
_PANELS = """() => Object.entries(window.servodFigures ?? {}).flatMap(([name, figure]) =>
  figure.panels.map((panel, k) => ({ name, k, group: panel.element.dataset.group, range: panel.range() })))"""
_DRAWN = """([name, k, curve]) => {
  const panel = window.servodFigures[name].panels[k];
  const paths = document.querySelectorAll(`[data-figure="${name}"] .panel`)[k].querySelectorAll("svg path");
  const corners = [...paths].map((p) => p.getAttribute("d").split(/[ML]/).length - 1);
  return { ...panel.drawn(curve), range: panel.range(), corners };
}"""


def panels(page: Page) -> list[dict[str, Any]]:
    """Every panel of the page: figure, place, group, range of x now."""
    return page.evaluate(_PANELS)


def drag(page: Page, name: str, k: int, first: float, last: float) -> None:
    """Drag over a panel, from one share of its width to another."""
    panel = page.locator(f'[data-figure="{name}"] .panel').nth(k).locator("svg").first
    panel.scroll_into_view_if_needed()
    box = panel.bounding_box()
    assert box is not None
    y = box["y"] + box["height"] / 2
    page.mouse.move(box["x"] + first * box["width"], y)
    page.mouse.down()
    page.mouse.move(box["x"] + (first + last) / 2 * box["width"], y, steps=3)
    page.mouse.move(box["x"] + last * box["width"], y, steps=3)
    page.mouse.up()
    page.wait_for_timeout(200)


def linked(page: Page) -> Iterator[str]:
    """What does not follow, when the first panel of each group is dragged over; all is shown again afterwards."""
    whole = panels(page)
    for group in dict.fromkeys(panel["group"] for panel in whole):
        first = next(panel for panel in whole if panel["group"] == group)
        drag(page, first["name"], first["k"], 0.4, 0.6)
        now = panels(page)
        shown = next(p["range"] for p in now if (p["name"], p["k"]) == (first["name"], first["k"]))
        if np.ptp(shown) > 0.6 * np.ptp(first["range"]):
            yield f"does not zoom: {first['name']} panel {first['k']}: {first['range']} to {shown}"
        for panel, before in zip(now, whole, strict=True):
            wanted = shown if panel["group"] == group else before["range"]
            if not np.allclose(panel["range"], wanted):
                yield f"does not move with {first['name']}: {panel['name']} panel {panel['k']}"
        page.evaluate("([name, k]) => window.servodFigures[name].panels[k].all()", [first["name"], first["k"]])


def sine(browser: Browser, folder: Path) -> Iterator[str]:
    """Zoom into the recorded sine by hand until some periods fill the picture; compare what is drawn with the rows."""
    if not (folder / "sine.html").exists():
        return
    with (folder / "sine.csv").open() as stream:
        rows = np.array([(float(r["t_s"]), float(r["position_rad"])) for r in csv.DictReader(stream)])
    page = browser.new_page(viewport={"width": 1440, "height": 900})
    page.goto((folder / "sine.html").resolve().as_uri())
    page.wait_for_function("document.documentElement.dataset.ready")
    first = panels(page)[0]
    while np.ptp(panels(page)[0]["range"]) > NEAR_S:
        before = np.ptp(panels(page)[0]["range"])
        half = min(max(0.5 * NEAR_S / before, 0.05), 0.3)
        drag(page, first["name"], first["k"], 0.5 - half, 0.5 + half)
        if np.ptp(panels(page)[0]["range"]) > 0.9 * before:
            yield f"the sine does not zoom beyond {before:g} s"
            return
    yield from _compare(page, first["name"], rows)
    page.close()


def _compare(page: Page, name: str, rows: np.ndarray) -> Iterator[str]:
    """Points and largest deviation of the curve of the position."""
    best, points, corners = np.inf, 0, 0
    for curve in range(2):  # reference and position, in whichever order
        drawn = page.evaluate(_DRAWN, [name, 0, curve])
        x, y = np.array(drawn["x"]), np.array(drawn["y"])
        inside = (x >= drawn["range"][0]) & (x <= drawn["range"][1])
        missed = np.abs(np.interp(x, rows[:, 0], rows[:, 1]) - y).max() / SINE_RAD
        if missed < best:
            best, points, corners = missed, int(inside.sum()), max(drawn["corners"])
    periods = np.ptp(drawn["range"]) * SINE_HZ
    print(
        f"sine of {SINE_HZ:g} Hz at {RATE_HZ} Hz, zoomed to {np.ptp(drawn['range']):.3f} s: "
        f"{points / periods:.1f} points in a period, at most {best:.1e} of the amplitude beside the recording, "
        f"{corners} corners drawn"
    )
    if points < LEAST_POINTS * periods or corners < LEAST_POINTS * periods:
        yield f"{points} points, {corners} corners in {periods:.1f} periods, at least {LEAST_POINTS} in each wanted"
    if best > MOST_MISSED:
        yield f"drawn {best:.1e} of the amplitude beside the recording, at most {MOST_MISSED:g} wanted"
