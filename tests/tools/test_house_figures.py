"""The figures of the house that hold already stay as they are."""

from __future__ import annotations

import ast

import figures
import pytest


def test_every_figure_but_the_length_holds() -> None:
    """The length does not: the plan's bound is of a program that did less."""
    found = figures.figures()
    assert len(found) == 11
    for figure in found:
        if not figure.name.startswith("lines"):
            assert figure.value <= figure.most, "\n".join([figure.name, *figure.where])


def test_an_effect_is_named_in_few_files_beside_its_own() -> None:
    figure = figures.effects()
    assert len(figure.where) > 20
    assert figure.value <= figure.most, "\n".join(figure.where)


@pytest.mark.parametrize(
    ("code", "found"),
    [
        ("LIST = ('cogging', 'inertia')", ["cogging", "inertia"]),
        ("TABLE = {'cogging': 1, 'residual': 2}", ["cogging"]),
        ("if name == 'inertia': pass", ["inertia"]),
        ("VALUES = {'inertia': 1.0, 'viscous': 2.0}", []),
        ("model.cogging, 'cogging_order', f(inertia=1)", []),
    ],
)
def test_names_of_effects_are_told_from_quantities(code: str, found: list[str]) -> None:
    names = {"cogging": False, "inertia": True}
    assert sorted(figures.named(ast.parse(code), names)) == found
