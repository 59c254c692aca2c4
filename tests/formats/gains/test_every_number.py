"""A sealed set with any one of its numbers changed is refused: every numeric leaf of a certified file is tried."""

from __future__ import annotations

import datetime
import functools
import operator
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from servod.common.errors import BadInput
from servod.common.yaml import parse_yaml, validate
from servod.formats.gains.gain_set import Certificate, CertificateCheck, GainSet, require_certificate
from servod.lab.synthesize.reference import reference_set
from tests.lab.synthesize.designs import table1, table1_set

Path = tuple[str | int, ...]
SAMPLED = 150  # of the matrices of the LMIs, evenly over the file; every other number is tried


def certified(gains: GainSet) -> GainSet:
    certificate = Certificate(
        valid=True,
        parameters_sha256=gains.parameters_sha256(),
        issued_by="test",
        issued_at=datetime.datetime(2026, 1, 1, tzinfo=datetime.UTC),
        checks=[CertificateCheck(name="pole", value=0.9, limit=1.0, margin=0.1, passed=True)],
        observations={"delay": 0.002},
    )
    return gains.model_copy(update={"certificate": certificate}).sealed()


def numbers(node: Any, at: Path = ()) -> Iterator[Path]:
    """Paths of all numbers below `node`; the version of the file format is no number of the design."""
    if isinstance(node, dict):
        for key, value in node.items():
            yield from numbers(value, (*at, key))
    elif isinstance(node, list):
        for index, value in enumerate(node):
            yield from numbers(value, (*at, index))
    elif isinstance(node, int | float) and not isinstance(node, bool) and at != ("schema_version",):
        yield at


@contextmanager
def changed(document: Any, path: Path) -> Iterator[Any]:
    """The file's content with the number at `path` changed by a millionth, or from 0 to a billionth."""
    value = functools.reduce(operator.getitem, path, document)
    with replaced(document, path, value * (1.0 + 1e-6) if value else 1e-9):
        yield document


@contextmanager
def replaced(document: Any, path: Path, number: float) -> Iterator[None]:
    """The file's content with `number` at `path`."""
    node = functools.reduce(operator.getitem, path[:-1], document)
    value, node[path[-1]] = node[path[-1]], number
    try:
        yield
    finally:
        node[path[-1]] = value


def accepted(document: Any) -> bool:
    try:
        require_certificate(validate(document, GainSet, "set"), accept_uncertified=False)
    except BadInput:
        return False
    return True


def accepted_with(document: Any, path: Path) -> bool:
    with changed(document, path) as other:
        return accepted(other)


def chosen(document: Any) -> list[Path]:
    """All numbers but those of the proofs' matrices, and an even sample of these."""
    every = list(numbers(document))
    proofs = [path for path in every if path[:2] in {("design", "regions"), ("design", "reference")}]
    others = [path for path in every if path not in set(proofs)]
    return others + proofs[:: max(1, len(proofs) // SAMPLED)]


@pytest.mark.parametrize("mode", ["deployed", "reference"])
def test_no_number_of_a_certified_set_can_be_changed(mode: str) -> None:
    found = table1_set() if mode == "deployed" else reference_set(table1())
    assert isinstance(found, GainSet)
    document = parse_yaml(certified(found).to_yaml(), "set")
    paths = chosen(document)
    assert len(paths) > 80 and accepted(document)
    assert [path for path in paths if accepted_with(document, path)] == []
    assert accepted(document)


def test_a_changed_hash_or_a_removed_seal_is_refused_as_well() -> None:
    gains = certified(table1_set())
    assert gains.seal is not None
    document = parse_yaml(gains.to_yaml(), "set")
    assert accepted(document)
    assert not accepted({key: value for key, value in document.items() if key != "seal"})
    assert not accepted(document | {"seal": "0" * 64})


@pytest.mark.parametrize("number", [float("nan"), float("inf")])
def test_a_number_that_is_not_finite_is_bad_input_wherever_it_stands(number: float) -> None:
    document = parse_yaml(table1_set().to_yaml(), "set")
    for path in chosen(document)[::8]:
        with replaced(document, path, number), pytest.raises(BadInput) as caught:
            validate(document, GainSet, "set")
        assert f"set: {'.'.join(map(str, path))}: found {number}" in str(caught.value)
