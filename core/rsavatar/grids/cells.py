"""From a grid's request to its jobs.

An axis named like a word of a job (``seed``, ``T``, ``ablation``, ``ablation.no_rs``, ...) holds values of that word.
Any other name makes an axis of *variants*: tables with a ``label`` and the words that the variant changes. Cells are
the product of the axes in the order in which they are written, the last one running fastest, then the ``includes``;
a cell that an entry of ``excludes`` describes is left out, and so is one that means the same job as an earlier cell.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import prod
from typing import Any

from pydantic import JsonValue

from rsavatar.errors import SpecError, expected
from rsavatar.grids.request import GridRequest
from rsavatar.spec import Ablation, JobSpec, resolve

LIMIT = 1000  # jobs of one grid, unless the caller sets another
COMBINATIONS = 100_000  # of a grid's axes, before its excludes
FULL = "full"  # the value of an ablation axis that removes nothing
WORDS = frozenset(field.alias or name for name, field in JobSpec.model_fields.items())
FLAGS = tuple(Ablation.model_fields)

Words = Mapping[str, Any]


@dataclass(frozen=True)
class Value:
    """One value of an axis: what people call it, and the words that it lays over the base."""

    label: str
    words: Words


@dataclass(frozen=True)
class Axis:
    """A name and its values."""

    name: str
    values: tuple[Value, ...]

    def find(self, label: object) -> Value | None:
        """The value that is called so, or is so."""
        return next((value for value in self.values if value.label == label_of(label)), None)


@dataclass(frozen=True)
class Cell:
    """One job of a grid. ``number`` counts all combinations, also those left out: it finds the place again."""

    number: int
    place: Mapping[str, str]  # axis -> label
    spec: JobSpec


def label_of(value: object) -> str:
    """How a value of an axis is written: as in TOML and JSON, text without its quotes."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, list):
        return "+".join(map(label_of, value)) or FULL
    return str(value)


def read_axes(request: GridRequest) -> tuple[Axis, ...]:
    """The axes of a request, in its order.

    Raises:
        SpecError: if an axis has no values, a value twice, or words that another axis has.
    """
    axes = tuple(_axis(name, values) for name, values in request.axes.items())
    owner: dict[str, str] = {}
    for axis in axes:
        for word in dict.fromkeys(word for value in axis.values for word in value.words if word != "ablation"):
            if owner.setdefault(word, axis.name) != axis.name:
                raise SpecError(expected(f"axes.{axis.name}", f"words that axis {owner[word]} does not set", word))
    return axes


def _axis(name: str, values: Sequence[JsonValue]) -> Axis:
    if not values:
        raise SpecError(expected(f"axes.{name}", "at least one value", "none"))
    found = tuple(_value(name, value) for value in values)
    labels = [value.label for value in found]
    if double := next((label for label in labels if labels.count(label) > 1), None):
        raise SpecError(expected(f"axes.{name}", "every value once", f"{double!r} twice"))
    return Axis(name, found)


def _value(name: str, value: JsonValue) -> Value:
    root, _, flag = name.partition(".")
    if name == "ablation":
        flags = [] if value == FULL else [part for item in _items(value) for part in label_of(item).split("+")]
        return Value(label_of(value), {"ablation": dict.fromkeys(flags, True)})
    if root == "ablation" and flag in FLAGS:
        return Value(label_of(value), {"ablation": {flag: value}})
    if name in WORDS:
        return Value(label_of(value), {name: value})
    if not isinstance(value, dict) or not isinstance(value.get("label"), str):
        wanted = f"a word of a job ({', '.join(sorted(WORDS))}), or tables with a label"
        raise SpecError(expected(f"axes.{name}", wanted, repr(value)))
    return Value(str(value["label"]), {key: item for key, item in value.items() if key != "label"})


def _items(value: JsonValue) -> list[JsonValue]:
    return value if isinstance(value, list) else [value]


def expand(request: GridRequest, limit: int = LIMIT) -> tuple[Cell, ...]:
    """Every job of a grid, validated.

    Raises:
        SpecError: naming the axis and the value that no job can have; or if there is no cell, or more than ``limit``.
    """
    axes = read_axes(request)
    combinations = prod(len(axis.values) for axis in axes)
    if combinations > COMBINATIONS:
        raise SpecError(expected("axes", f"at most {COMBINATIONS} combinations", combinations))
    cells: dict[str, Cell] = {}
    for number, chosen, words in _chosen(request, axes):
        spec = _resolve(chosen, words)
        cells.setdefault(spec.sha256(), Cell(number, {name: value.label for name, value in chosen.items()}, spec))
        if len(cells) > limit:
            raise SpecError(expected("grid", f"at most {limit} jobs", f"{limit + 1} or more"))
    if not cells:
        raise SpecError(expected("grid", "at least one job", "none that the excludes leave"))
    return tuple(cells.values())


def place_of(request: GridRequest, axes: Sequence[Axis], number: int) -> dict[str, str] | None:
    """The place of the cell with this number, without expanding the grid; None if there is no such cell."""
    beyond = number - prod(len(axis.values) for axis in axes)
    if beyond >= 0:
        if beyond >= len(request.includes):
            return None
        return {name: value.label for name, value in _included(request.includes[beyond], axes).items()}
    place = {}
    for axis in reversed(axes):
        number, index = divmod(number, len(axis.values))
        place[axis.name] = axis.values[index].label
    return dict(reversed(place.items()))


def _chosen(request: GridRequest, axes: Sequence[Axis]) -> Iterator[tuple[int, dict[str, Value], dict[str, Any]]]:
    """Number, place and words of every cell that is not left out."""
    excluded = [_described(entry, axes) for entry in request.excludes]
    number = -1
    for number, values in enumerate(itertools.product(*(axis.values for axis in axes))):
        chosen = {axis.name: value for axis, value in zip(axes, values, strict=True)}
        if not any(all(chosen[name].label in labels for name, labels in entry.items()) for entry in excluded):
            yield number, chosen, _laid(request.base, chosen)
    for entry in request.includes:
        number += 1
        chosen = _included(entry, axes)
        yield number, chosen, _laid(request.base, chosen)


def _described(entry: Words, axes: Sequence[Axis]) -> dict[str, set[str]]:
    """An entry of ``excludes``: axis to the labels that it leaves out."""
    by_name = {axis.name: axis for axis in axes}
    labels: dict[str, set[str]] = {}
    for name, values in entry.items():
        if name not in by_name:
            raise SpecError(
                expected("excludes", f"names of axes ({', '.join(by_name) or 'there are none'})", repr(name))
            )
        for value in _items(values) if name != "ablation" else [values]:
            if by_name[name].find(value) is None:
                known = ", ".join(known.label for known in by_name[name].values)
                raise SpecError(expected(f"excludes.{name}", f"one of {known}", repr(value)))
            labels.setdefault(name, set()).add(label_of(value))
    return labels


def _included(entry: Words, axes: Sequence[Axis]) -> dict[str, Value]:
    """An entry of ``includes``: values of axes by their labels, and other words of a job as they are."""
    by_name = {axis.name: axis for axis in axes}
    found: dict[str, Value] = {}
    for name, value in entry.items():
        known = by_name[name].find(value) if name in by_name else None
        if known is None and name not in WORDS:
            raise SpecError(expected(f"includes.{name}", "a value of an axis, or a word of a job", repr(value)))
        found[name] = known or Value(label_of(value), {name: value})
    return found


def _laid(base: Words, chosen: Mapping[str, Value]) -> dict[str, Any]:
    """The base with the words of the chosen values over it; flags of the ablation are laid one by one."""
    words = dict(base)
    for value in chosen.values():
        for word, item in value.words.items():
            both = isinstance(words.get(word), dict) and isinstance(item, dict)
            words[word] = {**words[word], **item} if both else item
    return words


def _resolve(chosen: Mapping[str, Value], words: Words) -> JobSpec:
    try:
        return resolve(words)
    except SpecError as error:
        raise SpecError(_blame(str(error), chosen)) from None


def _blame(sentence: str, chosen: Mapping[str, Value]) -> str:
    """The refusal of a cell, told of the axis that sets the refused word, or else of the base."""
    word = sentence.partition(":")[0].partition(".")[0]
    cell = ", ".join(f"{name}={value.label}" for name, value in chosen.items()) or "base"
    for name, value in reversed(list(chosen.items())):
        if word in value.words:
            return expected(
                f"axes.{name}", "values that every cell can have", f"{value.label!r} in {cell} ({sentence})"
            )
    return expected("base", "words that every cell can have", f"{cell} ({sentence})")
