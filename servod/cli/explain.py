"""`servoctl explain EFFECT`: the equation of an effect, its keys in the axis model file, and what tells it apart.

Reads nothing but the program's own tables; needs the lab extra, as the effects stand beside their search.
"""

from __future__ import annotations

import difflib
from typing import Annotated, Any

import typer

from servod.cli.common import JsonOption, example, print_json
from servod.cli.groups import effects
from servod.common.errors import BadInput

EXAMPLE = "servoctl explain stribeck"


def register(app: typer.Typer) -> None:
    """Add the verb to `app`."""
    app.command(name="explain", help=example("Explain an effect: equation, keys, units, ranges.", EXAMPLE))(explain)


def explain(
    effect: Annotated[
        str | None, typer.Argument(help="Name of an effect; none lists them all.", autocompletion=effects)
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Print the equation, source, keys (units, ranges), signature and separating experiment of EFFECT."""
    from servod.lab.diagnose.effects import NAMES
    from servod.lab.diagnose.explain import explain_effect, list_effects

    if effect is None:
        document: Any = list_effects()
    elif effect in NAMES:
        document = explain_effect(effect)
    else:
        near = difflib.get_close_matches(effect, NAMES, n=1)
        hint = f" (did you mean {near[0]}?)" if near else ""
        raise BadInput("EFFECT", repr(effect), ", ".join(NAMES) + hint)
    if as_json:
        print_json(document)
    elif effect is None:
        for name, statement in document.items():
            print(f"{name:30s} {statement}")
    else:
        _print(document)


def _print(document: dict[str, Any]) -> None:
    print(f"{document['effect']}: {document['statement']}.")
    for name in ("equation", "source", "shows", "experiment"):
        print(f"  {name}: {document[name]}")
    print(f"  confused with: {', '.join(document['confused_with'])}")
    print("  keys in the axis model file:")
    for key in document["keys"]:
        print(f"    {key['key']}  {key['meaning']}  {key['range']}")
