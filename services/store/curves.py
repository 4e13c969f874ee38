"""Training curves, thinned in the store so that what is drawn keeps every spike and is never long.

A curve is cut into buckets of equally many points; of each the lowest and the highest point stay, in their order, with
the first and the last of the whole curve.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

from sqlalchemy import CursorResult, Table, bindparam, func, select
from sqlalchemy.orm import Session

from services.errors import NotFoundError
from services.store.session import Store
from services.store.tables import JobRow, PointRow

POINTS = 1000  # most points of a curve, unless fewer are asked for
LEAST = 4  # first, last, lowest, highest

POINTS_OF = cast(Table, PointRow.__table__)
CURVE = (
    select(POINTS_OF.c.step, POINTS_OF.c.value)
    .where(POINTS_OF.c.job_id == bindparam("of_job"), POINTS_OF.c.key == bindparam("of_key"))
    .order_by(POINTS_OF.c.step)
)

Curve = list[tuple[int, float]]


def of_jobs(
    store: Store, job_ids: Sequence[str], keys: Sequence[str] = (), points: int = POINTS
) -> dict[str, dict[str, Curve]]:
    """Curves by job and key, each of at most ``points`` points; a job that reuses a result has its source's curves.

    Raises:
        NotFoundError: if one of the jobs does not exist.
    """
    with store.read() as session:
        known = select(JobRow.id, JobRow.reused_from).where(JobRow.id.in_(job_ids))
        source = {job_id: reused or job_id for job_id, reused in session.execute(known)}
        if missing := next((job_id for job_id in job_ids if job_id not in source), None):
            raise NotFoundError("job", "the id of a job", missing)
        drawn: dict[str, dict[str, Curve]] = {job_id: {} for job_id in source.values()}
        for job_id, curves in drawn.items():
            for key in keys or _keys(session, job_id):
                if curve := _read(session, job_id, key):
                    curves[key] = thin(curve, points)
    return {job_id: drawn[source[job_id]] for job_id in job_ids}


def _keys(session: Session, job_id: str) -> list[str]:
    """Names of a job's curves, one step of the index each, however many points there are."""
    found: list[str] = []
    while True:
        query = select(func.min(PointRow.key)).where(PointRow.job_id == job_id)
        key = session.scalar(query.where(PointRow.key > found[-1]) if found else query)
        if key is None:
            return found
        found.append(key)


def _read(session: Session, job_id: str, key: str) -> Curve:
    """All points of one curve, as the driver hands them out: wrapping a long curve costs more than reading it."""
    result = session.execute(CURVE, {"of_job": job_id, "of_key": key})
    return list(cast("CursorResult[Any]", result).cursor.fetchall())


def thin(curve: Curve, points: int) -> Curve:
    """At most ``points`` points of a curve: first and last, and of every bucket between them the lowest and highest."""
    if len(curve) <= points:
        return curve
    buckets = (max(points, LEAST) - 2) // 2
    inner = len(curve) - 2
    values = [value for _, value in curve]
    kept = [0]
    for bucket in range(buckets):
        start, stop = (1 + inner * i // buckets for i in (bucket, bucket + 1))
        part = values[start:stop]
        kept += sorted({start + part.index(min(part)), start + part.index(max(part))})
    return [curve[i] for i in (*kept, len(curve) - 1)]
