"""What the fields of the filter language mean in SQL. A field that is not in ``FIELDS`` cannot be asked for."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from sqlalchemy import ColumnElement, String, and_, cast, not_, or_, select

from rsavatar.spec import Ablation
from services.store import query
from services.store.records import Filters, State
from services.store.session import db_now
from services.store.tables import JobRow, ResultRow, TagRow

UNITS = {"s": 1.0, "m": 60.0, "h": 3600.0, "d": 86_400.0, "w": 604_800.0}
DURATION = re.compile(r"(?P<number>\d+(?:\.\d+)?)(?P<unit>[smhdw])")
COMPARE: Mapping[str, Callable[[Any, Any], ColumnElement[bool]]] = {
    ":": lambda column, value: column == value,
    "=": lambda column, value: column == value,
    "!=": lambda column, value: column != value,
    "<": lambda column, value: column < value,
    "<=": lambda column, value: column <= value,
    ">": lambda column, value: column > value,
    ">=": lambda column, value: column >= value,
}
TURNED = {"<": ">", "<=": ">=", ">": "<", ">=": "<="}  # a younger age is a later instant
EQUALITY = frozenset({":", "=", "!="})

Meaning = Callable[[query.Comparison, str], ColumnElement[bool]]


@dataclass(frozen=True)
class Field:
    """What a test on a field means, and how it is explained."""

    about: str
    test: Meaning


def words(column: ColumnElement[Any], choices: frozenset[str] | None = None) -> Meaning:
    """Text: equal to a value, or with ``*`` anywhere in it, like it."""

    def test(asked: query.Comparison, value: str) -> ColumnElement[bool]:
        _require(asked, EQUALITY, value)
        if choices is not None and "*" not in value and value not in choices:
            query.refuse(asked.at, f"{asked.field} one of {', '.join(sorted(choices))}", repr(value))
        if "*" not in value:
            return COMPARE[asked.operator](column, value)
        escaped = re.sub(r"([\\%_])", r"\\\1", value).replace("*", "%")
        like = column.like(escaped, escape="\\")
        return not_(like) if asked.operator == "!=" else like

    return test


def number(column: ColumnElement[Any]) -> Meaning:
    """A finite number; a job without one fits no comparison."""

    def test(asked: query.Comparison, value: str) -> ColumnElement[bool]:
        return COMPARE[asked.operator](column, _number(asked, value))

    return test


def instant(column: ColumnElement[Any]) -> Meaning:
    """An instant as a date, or as an age: ``created<2d`` is younger than two days, ``created>2026-11-01`` after it."""

    def test(asked: query.Comparison, value: str) -> ColumnElement[bool]:
        _require(asked, frozenset(TURNED), value)
        if (age := DURATION.fullmatch(value)) is not None:
            return COMPARE[TURNED[asked.operator]](column, db_now() - _seconds(age))
        try:
            when = datetime.fromisoformat(value)
        except ValueError:
            query.refuse(
                asked.at, f"{asked.field} with an age such as 2d or 36h, or a date such as 2026-11-01", repr(value)
            )
        return COMPARE[asked.operator](column, (when if when.tzinfo else when.replace(tzinfo=UTC)).timestamp())

    return test


def duration(column: ColumnElement[Any]) -> Meaning:
    """Seconds, or a number with one of the units s, m, h, d, w."""

    def test(asked: query.Comparison, value: str) -> ColumnElement[bool]:
        found = DURATION.fullmatch(value)
        seconds = _seconds(found) if found is not None else _number(asked, value)
        return COMPARE[asked.operator](column, seconds)

    return test


def tag(asked: query.Comparison, value: str) -> ColumnElement[bool]:
    """A job that has a tag; with ``!=`` one that has not."""
    _require(asked, EQUALITY, value)
    tagged = words(TagRow.tag.expression)(query.Comparison(asked.field, ":", asked.values, asked.at), value)
    found = JobRow.id.in_(select(TagRow.job_id).where(tagged))
    return not_(found) if asked.operator == "!=" else found


def ablation(asked: query.Comparison, value: str) -> ColumnElement[bool]:
    """A job without a component, by the name of the flag; ``full`` for one with all of them."""
    _require(asked, EQUALITY, value)
    flags = {name: JobRow.spec["ablation"][name].as_boolean() for name in Ablation.model_fields}
    if value != "full" and value not in flags:
        query.refuse(asked.at, f"ablation one of full, {', '.join(flags)}", repr(value))
    found = not_(or_(*flags.values())) if value == "full" else flags[value]
    return not_(found) if asked.operator == "!=" else found


def of_result(column: ColumnElement[Any]) -> Meaning:
    """A number of a job's result, or of the result that it reuses."""

    def test(asked: query.Comparison, value: str) -> ColumnElement[bool]:
        fits = select(ResultRow.job_id).where(COMPARE[asked.operator](column, _number(asked, value)))
        return JobRow.id.in_(fits) | JobRow.reused_from.in_(fits)

    return test


def _require(asked: query.Comparison, operators: frozenset[str], value: str) -> None:
    if asked.operator not in operators:
        query.refuse(asked.at, f"{asked.field} with one of {' '.join(sorted(operators))}", f"{asked.operator}{value}")


def _number(asked: query.Comparison, value: str) -> float:
    try:
        found = float(value)
    except ValueError:
        found = math.nan
    if not math.isfinite(found):
        query.refuse(asked.at, f"{asked.field} with a number", repr(value))
    return found


def _seconds(found: re.Match[str]) -> float:
    return float(found["number"]) * UNITS[found["unit"]]


def _spec(name: str) -> Any:
    return JobRow.spec[name]


FIELDS: Mapping[str, Field] = {
    "id": Field("id, or the beginning of one with *", words(JobRow.id.expression)),
    "state": Field("state of the job", words(JobRow.state.expression, frozenset(map(str, State)))),
    "method": Field("reconstruction method", words(JobRow.method.expression)),
    "subject": Field("subject", words(JobRow.subject.expression)),
    "owner": Field("who submitted it", words(JobRow.owner.expression)),
    "grid": Field("id of its grid", words(JobRow.grid_id.expression)),
    "error": Field("kind of its failure", words(JobRow.error_kind.expression)),
    "stage": Field("what it does now", words(JobRow.stage.expression)),
    "notes": Field("text of its notes, with * for anything", words(JobRow.notes.expression)),
    "tag": Field("one of its tags", tag),
    "preset": Field("preset", words(_spec("preset").as_string())),
    "ablation": Field("a component that is left out, or full", ablation),
    "motion": Field("kind of motion", words(_spec("motion").as_string())),
    "T": Field("row bands as they were asked for", words(cast(_spec("T").as_string(), String))),
    "seed": Field("seed", number(_spec("seed").as_integer())),
    "K": Field("source frames per output frame", number(_spec("K").as_integer())),
    "P": Field("control points", number(_spec("P").as_integer())),
    "lambda": Field("weight of the penalty", number(_spec("lambda").as_float())),
    "iterations": Field("optimiser steps", number(_spec("iterations").as_integer())),
    "priority": Field("priority", number(JobRow.priority.expression)),
    "attempt": Field("attempts so far", number(JobRow.attempt.expression)),
    "failures": Field("failures of the infrastructure", number(JobRow.failures.expression)),
    "step": Field("step of its stage", number(JobRow.step.expression)),
    "psnr": Field("PSNR so far, dB", number(JobRow.psnr.expression)),
    "loss": Field("training loss so far", number(JobRow.loss.expression)),
    "gaussians": Field("number of Gaussians", number(JobRow.gaussians.expression)),
    "ssim": Field("SSIM of the result", of_result(ResultRow.ssim.expression)),
    "lpips": Field("LPIPS of the result", of_result(ResultRow.lpips.expression)),
    "flip": Field("FLIP of the result", of_result(ResultRow.flip.expression)),
    "joint_mm": Field("joint error of the result, mm", of_result(ResultRow.joint_mm.expression)),
    "created": Field("age or date of its submission", instant(JobRow.created_at.expression)),
    "started": Field("age or date of its start", instant(JobRow.started_at.expression)),
    "finished": Field("age or date of its end", instant(JobRow.finished_at.expression)),
    "duration": Field("time from start to end", duration(JobRow.finished_at - JobRow.started_at)),
    "eta": Field("time that it says is left", duration(JobRow.eta_seconds.expression)),
}


def where(filters: Filters) -> list[ColumnElement[bool]]:
    """The conditions of a listing.

    Raises:
        RequestError: if the query of ``filters`` cannot be understood, saying where.
    """
    wanted: list[tuple[ColumnElement[Any], str | None]] = [
        (JobRow.state.expression, filters.state),
        (JobRow.method.expression, filters.method),
        (JobRow.subject.expression, filters.subject),
        (JobRow.grid_id.expression, filters.grid),
        (_spec("preset").as_string(), filters.preset),
    ]
    conditions = [column == value for column, value in wanted if value is not None]
    if filters.tag is not None:
        conditions.append(JobRow.id.in_(select(TagRow.job_id).where(TagRow.tag == filters.tag)))
    if filters.seeds:
        conditions.append(_spec("seed").as_integer().in_(filters.seeds))
    node = query.parse(filters.query or "")
    return conditions if node is None else [*conditions, to_sql(node)]


def to_sql(node: query.Node) -> ColumnElement[bool]:
    """A tree as a condition on jobs.

    Raises:
        RequestError: if a field is unknown, or a value does not fit it.
    """
    if isinstance(node, query.Not):
        return not_(to_sql(node.inside))
    if isinstance(node, query.Both):
        return (and_ if node.every else or_)(*map(to_sql, node.parts))
    field = FIELDS.get(node.field)
    if field is None:
        query.refuse(node.at, f"one of the fields {', '.join(FIELDS)}", repr(node.field))
    if len(node.values) > 1 and node.operator not in EQUALITY:
        query.refuse(node.at, f"one value after {node.operator}", repr(",".join(node.values)))
    tests = [field.test(node, value) for value in node.values]
    return and_(*tests) if node.operator == "!=" else or_(*tests)
