"""The tables of a trial for terminal, manual and page.

Made from the JSON document alone, so that a kept document gives the same tables.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from servod.common.units import counted
from servod.lab.report.figure import PageTable
from servod.qualify.blind.count import (
    GOALS,
    HARDER_GOALS,
    LEAST_COVERED,
    MOST_ERROR,
    MOST_HELD_OUT,
    MOST_OVER_TRUE,
    TELLING,
)
from servod.qualify.blind.plan import Sort

RESULT, EFFECTS, CONFIDENCE, HIDDEN, CASES = (
    "Results", "By effect", "Confidence", "By what hid the effect", "Every case",
)  # fmt: skip

_SORTS = {
    Sort.SINGLE: "one effect: named, and nothing else",
    Sort.PAIR: "two effects: both named, and nothing else",
    Sort.NOTHING: "nothing hidden: adequate",
    Sort.UNKNOWN: "physics on nobody's list: given no known name",
}

_SPENT = {"wall_s": "time of a diagnosis, s", "cpu_s": "processor time, s", "memory_mib": "memory, MiB"}


def all_tables(found: Mapping[str, Any]) -> list[PageTable]:
    """All tables, the results first."""
    return [results(found), effects(found), confidences(found), hidden(found), every_case(found)]


def sentences(found: Mapping[str, Any]) -> Iterator[str]:
    """What was done, in sentences."""
    own = found["engine"] == "own"
    more = "1 % of other effects, four times the noise and other forms in the plant" if own else "four times the noise"
    harder = f", with {more}" if found["harder"] else ""
    null = f" and {found['null']} that conceal nothing" if found["null"] else ""
    plant = "an independent plant" if own else "an independent plant and moved by MuJoCo"
    diagnosed = f"servod {found['version']}" + (f", sources {found['sources'][:12]}," if found["sources"] else "")
    yield (
        f"{counted(found['cases'], 'case')} of seed {found['seed']}{null}{harder}: axes drawn by {plant}, recorded in "
        f"a closed loop, diagnosed by {diagnosed} from their folders alone. SHA-256 of the truth, told "
        f"before: {found['sha256']}."
    )
    if found["times"]["hurried"]:
        yield f"The time limit may have ended {found['times']['hurried']} diagnoses early: too little of the processor."
    for case, named in found["false_alarms"].items():
        yield f"False alarm: {', '.join(named)} in {case}, where nothing is hidden."


def verdict(found: Mapping[str, Any]) -> str:
    """How many answers are right, and how many false alarms there were."""
    right = sum(bool(case["right"]) for case in found["results"])
    return f"{right} of {len(found['results'])} answers are right; {len(found['false_alarms'])} false alarms."


def results(found: Mapping[str, Any]) -> PageTable:
    """What a trial is judged by, with the goals."""
    goals = HARDER_GOALS if found["harder"] else GOALS
    rows = [
        _counted(_SORTS[sort], found["table"][sort.value], goals.get(sort)) for sort in Sort if sort in found["table"]
    ]
    if found["unexplained"]["cases"]:
        rows.append(_counted("of these: found, and called unexplained", found["unexplained"], None))
    parameters = found["parameters"]["all"]
    size = f"{parameters['parameters']} values, {parameters['missing']} of them not told"
    rows.append(_figure("parameters: median error", parameters["median_error"], size, MOST_ERROR, percent))
    covered = parameters["covered"]
    rows.append(_figure("parameters: 95 % intervals that cover", covered, size, LEAST_COVERED, percent, "≥"))
    rows += _held_out(found["held_out"])
    for key, text in _SPENT.items():
        spread = found["times"][key]
        rows.append((f"{text}: median, max", f"{number(spread['median'])}, {number(spread['max'])}", "", ""))
    return PageTable(RESULT, ("what", "found", "of", "goal"), tuple(rows))


def _held_out(spreads: Mapping[str, Any]) -> Iterator[tuple[str, ...]]:
    """Errors of windows that no diagnosis saw; what is left out of a median stands beside it."""
    every, telling, true = (spreads[k] for k in ("after_over_before_all", "after_over_before", "after_over_true"))
    ratio = "held-out windows of 0.25 s: error after / before, median"
    some = (
        f"{telling['count']} of {every['count']} cases: believed model {TELLING:g} times the true one's, or no true one"
    )
    yield _figure(ratio, telling["median"], some, MOST_HELD_OUT, number)
    yield ratio, number(every["median"]), f"all {every['count']} cases with an effect", ""
    ratio = "held-out windows of 0.25 s: error after / true model's, median"
    yield _figure(ratio, true["median"], f"{true['count']} cases", MOST_OVER_TRUE, number)


def _counted(text: str, counted: Mapping[str, Any], goal: float | None) -> tuple[str, ...]:
    low, high = counted["interval"]
    of = f"{counted['right']}/{counted['cases']} [{100 * low:.0f}, {100 * high:.0f}] %"
    return text, percent(counted["share"]), of, "" if goal is None else f"≥ {100 * goal:.0f} %"


def _figure(
    text: str, value: float | None, of: str, goal: float, shown: Callable[[float | None], str], sign: str = "≤"
) -> tuple[str, ...]:
    return text, shown(value), of, f"{sign} {shown(goal)}"


def effects(found: Mapping[str, Any]) -> PageTable:
    """For each effect: named how often, parameters, and as what it was mistaken."""
    rows = []
    for effect, counts in found["by_effect"].items():
        parameters = found["parameters"]["by_effect"].get(effect, {"median_error": None, "covered": None})
        others = {name: n for name, n in found["confusion"][effect].items() if name != effect}
        mistaken = ", ".join(f"{name} {n}" for name, n in sorted(others.items(), key=lambda item: -item[1]))
        named = f"{counts['right']}/{counts['cases']}"
        rows.append((effect, named, percent(parameters["median_error"]), percent(parameters["covered"]), mistaken))
    header = ("effect", "named", "median error of parameters", "intervals that cover", "beside it or instead")
    return PageTable(EFFECTS, header, tuple(rows))


def confidences(found: Mapping[str, Any]) -> PageTable:
    """What findings state and how many are right."""
    rows = []
    for part in found["calibration"]:
        span = f"{part['low']:g} to {part['high']:g}"
        rows.append((span, str(part["cases"]), percent(part["stated"]), percent(part["share"])))
    return PageTable(CONFIDENCE, ("stated confidence", "findings", "stated on average", "right"), tuple(rows))


def hidden(found: Mapping[str, Any]) -> PageTable:
    """Right answers by cover, form and joint."""
    rows: list[tuple[str, ...]] = []
    for key, text in (("by_cover", "cover"), ("by_form", "form"), ("by_joint", "joint")):
        rows += [_counted(f"{text}: {name}", counted, None)[:3] for name, counted in found[key].items()]
    return PageTable(HIDDEN, ("what hid it", "right", "of"), tuple(rows))


def every_case(found: Mapping[str, Any]) -> PageTable:
    """One row a case."""
    rows = []
    for case in sorted(found["results"], key=lambda case: bool(case["right"])):  # the wrong ones first
        named = ", ".join(f"{name} ({sure:.2f})" for name, sure in case["named"].items())
        concealed = ", ".join(case["concealed"]) or "nothing"
        more = ", ".join(filter(None, (case["joint"], case["cover"], "other form" if case["other_form"] else "")))
        rows.append((case["case"], concealed, more, case["verdict"], named, "right" if case["right"] else "wrong"))
    return PageTable(CASES, ("case", "concealed", "axis", "verdict", "named", "answer"), tuple(rows))


def markdown(found: Mapping[str, Any]) -> str:
    """prove.md: sentences and all tables."""
    parts = ["# A blind trial of the diagnosis", *sentences(found)]
    for table in all_tables(found):
        parts += [f"## {table.title}", table.markdown()]
    return "\n\n".join(parts) + "\n"


def text(found: Mapping[str, Any]) -> str:
    """What the terminal shows: results, and what each effect was mistaken for."""
    return "\n\n".join([*sentences(found), *(_aligned(table) for table in (results(found), effects(found)))])


def _aligned(table: PageTable) -> str:
    lines: Sequence[Sequence[str]] = (table.header, *table.rows)
    widths = [max(len(line[i]) for line in lines) for i in range(len(table.header))]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip() for line in lines
    )


def percent(value: float | None) -> str:
    """A share as percent; a dash where there is none."""
    return "–" if value is None else f"{100.0 * value:.3g} %"


def number(value: float | None) -> str:
    """A number with three digits; a dash where there is none."""
    return "–" if value is None else f"{value:.3g}"
