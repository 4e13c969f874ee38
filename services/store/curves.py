"""Training curves, thinned in the store so that what is drawn keeps every spike and is never long.

A curve is cut into buckets of equally many points; of each the lowest and the highest point stay, in their order, with
the first and the last of the whole curve.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import groupby
from operator import itemgetter
from typing import Any

from sqlalchemy import select

from services.errors import NotFoundError
from services.store.session import Store
from services.store.tables import JobRow, PointRow

POINTS = 1000  # most points of a curve, unless fewer are asked for
LEAST = 4  # first, last, lowest, highest

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
        columns = (PointRow.job_id, PointRow.key, PointRow.step, PointRow.value)
        query = select(*columns).where(PointRow.job_id.in_(set(source.values()))).order_by(*columns[:3])
        rows = session.execute(query.where(PointRow.key.in_(keys)) if keys else query).all()
    drawn: dict[str, dict[str, Curve]] = {}
    for job_id, key, curve in _curves(rows):
        drawn.setdefault(job_id, {})[key] = thin(curve, points)
    return {job_id: drawn.get(source[job_id], {}) for job_id in job_ids}


def _curves(rows: Sequence[Any]) -> Iterator[tuple[str, str, Curve]]:
    for (job_id, key), group in groupby(rows, itemgetter(0, 1)):
        yield job_id, key, [(row[2], row[3]) for row in group]


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
