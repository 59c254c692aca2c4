"""What is believed of an axis: the nominal model, its own parameters within bounds, and terms of physics added to it.

Stands between the effects' files and the fit. A hypothesis turns a vector of coordinates into an axis model; the
coordinates are logarithms or multiples of a natural size, so that all of them are of the order of one.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servod.formats.model.axis_model import AxisModel

Array = NDArray[np.float64]

#: The key of an unknown that is a factor on the model's own: 1 is no effect.
LEVEL = "level_factor"

#: A factor among the numbers of an effect that a plainer effect within it is alone.
PLAINER_FACTOR = "level"
Document = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Unknown:
    """A number to estimate. `size` 0 means its coordinate is the logarithm, else it is value/size.

    `spread` is the standard deviation, in coordinates, of what is believed of it before any data; `start` its centre;
    `nudge` the step of derivatives, large where the mismatch has steps of its own.
    """

    key: str
    unit: str
    start: float
    low: float
    high: float
    size: float = 0.0
    spread: float = math.inf
    nudge: float = 1e-3

    def coordinate(self, value: float) -> float:
        """Coordinate of a value."""
        return math.log(value) if self.size == 0.0 else value / self.size

    def value(self, coordinate: float) -> float:
        """Value of a coordinate, within the bounds."""
        plain = math.exp(min(coordinate, 700.0)) if self.size == 0.0 else coordinate * self.size
        return min(max(plain, self.low), self.high)


@dataclass(frozen=True)
class Reported:
    """A parameter as people read it: name, value and unit."""

    name: str
    value: float
    unit: str


#: Writes a term's values into a model document.
Writer = Callable[[Document, Sequence[float]], None]

#: Turns a term's values (and the model document they stand in) into what is reported.
Reporter = Callable[[Document, Sequence[float]], list[Reported]]


#: Writes what differs in one recording, by its number, into its model document.
EachWriter = Callable[[Document, Sequence[float], int], None]


@dataclass(frozen=True)
class Term:
    """One effect in one form: its unknowns, how they are written, and bounds of the model's own that it opens.

    `opens` maps keys of the base to new (low, high) and `begins` to start values. Terms without unknowns open only.
    `each` writes what differs from recording to recording. Its first unknown is a factor on those keys of the model's
    own that it `scales`.
    """

    effect: str
    form: str
    unknowns: tuple[Unknown, ...]
    write: Writer
    report: Reporter
    opens: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    begins: Mapping[str, float] = field(default_factory=dict)
    each: EachWriter | None = None
    scales: tuple[str, ...] = ()

    @property
    def numbers(self) -> int:
        """How many numbers it needs: its own unknowns and those of the model that it opens."""
        return len(self.unknowns) + len(self.opens)


@dataclass(frozen=True)
class Hypothesis:
    """The nominal model's document, the unknowns of its own, and the terms added."""

    document: Document
    base: tuple[Unknown, ...]
    terms: tuple[Term, ...] = ()

    @cached_property
    def unknowns(self) -> tuple[Unknown, ...]:
        """All unknowns: those of the base, with bounds opened where a term says so, then those of each term."""
        opened = {key: bounds for term in self.terms for key, bounds in term.opens.items()}
        base = [_opened(u, *opened[u.key]) if u.key in opened else u for u in self.base]
        return (*base, *(u for term in self.terms for u in term.unknowns))

    @cached_property
    def start(self) -> Array:
        """Coordinates of the start values."""
        return np.array([u.coordinate(u.start) for u in self.unknowns])

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        """Lowest and highest coordinates."""
        low = np.array([u.coordinate(u.low) for u in self.unknowns])
        return low, np.array([u.coordinate(u.high) for u in self.unknowns])

    @cached_property
    def prior(self) -> tuple[Array, Array]:
        """Centres and precisions (1/spread) of what is believed beforehand; centres are those of the base."""
        return self.start, np.array([1.0 / u.spread for u in self.unknowns])

    def with_term(self, term: Term) -> Hypothesis:
        """This hypothesis and one term more."""
        return Hypothesis(self.document, self.base, (*self.terms, term))

    def without(self, index: int) -> Hypothesis:
        """This hypothesis less its term `index`."""
        return Hypothesis(self.document, self.base, self.terms[:index] + self.terms[index + 1 :])

    def values(self, coordinates: Array) -> list[float]:
        """Values of the unknowns."""
        return [u.value(float(c)) for u, c in zip(self.unknowns, coordinates, strict=True)]

    def beside(self, coordinates: Array) -> Array:
        """Start coordinates of the last term beside others that stand at `coordinates`."""
        term = self.terms[-1]
        start = self.start.copy()
        start[: len(coordinates)] = coordinates
        for index, unknown in enumerate(self.base):
            if unknown.key in term.begins:
                start[index] = unknown.coordinate(term.begins[unknown.key])
        return start

    def share(self, index: int) -> slice:
        """Where the unknowns of term `index` stand among all."""
        first = len(self.base) + sum(len(term.unknowns) for term in self.terms[:index])
        return slice(first, first + len(self.terms[index].unknowns))

    def written(self, coordinates: Array) -> Document:
        """The model document at these coordinates."""
        document = copy.deepcopy(self.document)
        values = self.values(coordinates)
        for unknown, value in zip(self.base, values, strict=False):
            put(document, unknown.key, value)
        for index, term in enumerate(self.terms):
            term.write(document, values[self.share(index)])
        return document

    def model(self, coordinates: Array) -> AxisModel:
        """The axis model at these coordinates. Raises pydantic's ValidationError where it makes no sense."""
        return AxisModel.model_validate(self.written(coordinates))

    def models(self, coordinates: Array, recordings: int) -> list[AxisModel]:
        """One model for each recording, or a single one for all. Raises like `model`."""
        if all(term.each is None for term in self.terms):
            return [self.model(coordinates)]
        document, values = self.written(coordinates), self.values(coordinates)
        found = []
        for recording in range(recordings):
            own = copy.deepcopy(document)
            for index, term in enumerate(self.terms):
                if term.each is not None:
                    term.each(own, values[self.share(index)], recording)
            found.append(AxisModel.model_validate(own))
        return found


def _opened(unknown: Unknown, low: float, high: float) -> Unknown:
    """With other bounds; what was known beforehand goes where they are wider, and holds where they are narrower."""
    wider = low < unknown.low or high > unknown.high
    return replace(unknown, low=low, high=high, spread=math.inf if wider else unknown.spread)


def put(document: Document, key: str, value: float) -> None:
    """Set the value of a dotted key, making groups on the way."""
    *groups, last = key.split(".")
    for group in groups:
        document = document.setdefault(group, {})
    document[last] = value


def get(document: Document, key: str, default: float = 0.0) -> float:
    """The value of a dotted key, or `default` where it is missing."""
    found: Any = document
    for part in key.split("."):
        found = found.get(part) if isinstance(found, dict) else None
    return default if found is None else float(found)
