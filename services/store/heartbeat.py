"""The statement of a heartbeat, built once: it is what a service with many running jobs says most."""

from __future__ import annotations

from functools import cache
from typing import Any, cast

from sqlalchemy import Double, Table, bindparam, update
from sqlalchemy.sql.dml import ReturningUpdate

from services.store.records import State
from services.store.session import db_now
from services.store.tables import JobRow


@cache
def renewal(columns: tuple[str, ...]) -> ReturningUpdate[Any]:
    """Renew an attempt's lease and set ``columns``. Parameters: ``new_COLUMN``, of_job, of_attempt, for_seconds."""
    jobs = cast(Table, JobRow.__table__)
    mine = (jobs.c.id == bindparam("of_job")) & (jobs.c.attempt == bindparam("of_attempt"))
    news = {name: bindparam(f"new_{name}", type_=jobs.c[name].type) for name in columns}
    lease = db_now() + bindparam("for_seconds", type_=Double)
    change = update(jobs).where(mine, jobs.c.state == State.RUNNING).values(lease_until=lease, **news)
    return change.returning(jobs.c.cancel_requested_at, jobs.c.pause_requested_at)
