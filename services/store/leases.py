"""Who runs a job: claims, heartbeats, endings and the sweep, all fenced by the attempt number.

1. ``claim`` sets a waiting row to running by compare-and-set and raises ``attempt``, the fencing token.
2. ``beat`` renews the lease and stores what the job says, in one transaction, only while the token is still the row's.
3. Every ending (``succeed``, ``fail``, ``release``, ...) does the same; a job's result exists exactly once.
4. ``expire`` gives the jobs of silent workers back to the queue, or declares them dead after too many failures.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sqlalchemy import ColumnElement, case, func, insert, select, update
from sqlalchemy.orm import Session

from services.errors import FencedError
from services.store import artifacts, events, metrics
from services.store.records import Batch, Claim, Event, Failure, Look, Orders, Outcome, State
from services.store.session import Store, db_now
from services.store.tables import JobRow, SchedulerRow

LONGEST_BACKOFF = 300.0
UNSEEN = {"synchronize_session": False}  # rows in memory need not follow an UPDATE
IDLE = {"lease_owner": None, "lease_until": None, "cancel_requested_at": None, "pause_requested_at": None}
DUE = (JobRow.state == State.QUEUED) & (JobRow.not_before <= db_now())


def claim(store: Store, owner: str, lease_seconds: float) -> Claim | None:
    """Take the most urgent job that may run now; None when there is none. A lost race looks for the next one."""
    while True:
        with store.write() as session:
            queue = select(JobRow).where(DUE).order_by(JobRow.priority.desc(), JobRow.id).limit(1)
            row = session.scalar(queue)
            if row is None:
                return None
            unchanged = (JobRow.id == row.id) & (JobRow.attempt == row.attempt) & (JobRow.state == State.QUEUED)
            values = {
                "state": State.RUNNING,
                "attempt": JobRow.attempt + 1,
                "lease_owner": owner,
                "lease_until": db_now() + lease_seconds,
                "started_at": func.coalesce(JobRow.started_at, db_now()),
            }
            change = update(JobRow).where(unchanged).values(**values).returning(JobRow.attempt)
            taken = session.scalar(change, execution_options=UNSEEN)
            if taken is not None:
                events.append(session, row.id, [events.state_event(State.RUNNING, attempt=taken)])
                return Claim(row.id, taken, row.spec, row.subject)


def beat(store: Store, claim: Claim, batch: Batch, lease_seconds: float) -> Orders:
    """Renew the lease, store ``batch``, and bring back what users asked for.

    Raises:
        FencedError: if the job was given away; nothing of ``batch`` is stored.
    """
    values: dict[str, Any] = {"lease_until": db_now() + lease_seconds, **_columns(batch.look)}
    with store.write() as session:
        asked = _fenced(session, claim, values)
        events.append(session, claim.job_id, batch.events)
        metrics.put_points(session, claim.job_id, batch.points)
        artifacts.put(session, claim.job_id, batch.artifacts)
        return asked


def _columns(look: Look | None) -> dict[str, Any]:
    if look is None:
        return {}
    known = {"loss": look.loss, "psnr": look.psnr, "gaussians": look.gaussians}
    progress = {"stage": look.stage, "step": look.step, "steps": look.steps, "eta_seconds": look.eta_seconds}
    return progress | {name: value for name, value in known.items() if value is not None}


def _fenced(session: Session, claim: Claim, values: Mapping[str, Any]) -> Orders:
    mine = (JobRow.id == claim.job_id) & (JobRow.attempt == claim.attempt) & (JobRow.state == State.RUNNING)
    orders = (JobRow.cancel_requested_at, JobRow.pause_requested_at)
    change = update(JobRow).where(mine).values(**values).returning(*orders)
    row = session.execute(change, execution_options=UNSEEN).one_or_none()
    if row is None:
        raise FencedError("attempt", f"the running attempt of job {claim.job_id}", claim.attempt)
    return Orders(row[0] is not None, row[1] is not None)


def succeed(store: Store, claim: Claim, outcome: Outcome) -> None:
    """End a job with its result: state, result, scores and artifacts in one transaction.

    Raises:
        FencedError: if the job was given away; nothing is stored.
    """
    columns = {"psnr": outcome.means.get("psnr"), "gaussians": outcome.gaussians, "eta_seconds": 0.0}
    ended = {"finished_at": db_now(), "error": None, "error_kind": None}
    with store.write() as session:
        _fenced(session, claim, {"state": State.SUCCEEDED, **ended, **IDLE, **columns})
        metrics.put_outcome(session, claim, outcome)
        artifacts.put(session, claim.job_id, outcome.artifacts)
        events.append(session, claim.job_id, [events.state_event(State.SUCCEEDED, means=dict(outcome.means))])


def fail(store: Store, claim: Claim, kind: Failure, message: str, backoff: float) -> State:
    """End an attempt badly. Infrastructure failures wait and try again until the attempts are used up, then ``dead``.

    Of several infrastructure failures the first message is kept on the job: it is the one that explains.

    Raises:
        FencedError: if the job was given away.
    """
    retry = kind is Failure.INFRASTRUCTURE
    with store.write() as session:
        row = session.get_one(JobRow, claim.job_id)
        keep = retry and row.error is not None
        error = {} if keep else {"error_kind": str(kind), "error": message}
        values = error | _after_failure(row, backoff, retry=retry)
        _fenced(session, claim, values)
        state = State(values["state"])
        events.append(session, claim.job_id, [events.state_event(state, reason=message, failure=str(kind))])
        return state


def _after_failure(row: JobRow, backoff: float, *, retry: bool) -> dict[str, Any]:
    failures = row.failures + 1
    if row.cancel_requested_at is not None:
        return {"state": State.CANCELLED, "failures": failures, "finished_at": db_now(), **IDLE}
    if not retry:
        return {"state": State.FAILED, "failures": failures, "finished_at": db_now(), **IDLE}
    if failures >= row.max_attempts:
        return {"state": State.DEAD, "failures": failures, "finished_at": db_now(), **IDLE}
    wait = min(LONGEST_BACKOFF, backoff * 2.0 ** (failures - 1))
    state = State.PAUSED if row.pause_requested_at is not None else State.QUEUED
    return {"state": state, "failures": failures, "not_before": db_now() + wait, **IDLE}


def release(store: Store, claim: Claim) -> State:
    """Give an interrupted job back: cancelled or paused where a user asked for it, else queued. No failure is counted.

    Raises:
        FencedError: if the job was given away.
    """
    asked_to_cancel = JobRow.cancel_requested_at.is_not(None)
    state = case(
        (asked_to_cancel, str(State.CANCELLED)),
        (JobRow.pause_requested_at.is_not(None), str(State.PAUSED)),
        else_=str(State.QUEUED),
    )
    with store.write() as session:
        values = {"state": state, "finished_at": case((asked_to_cancel, db_now()), else_=None), **IDLE}
        _fenced(session, claim, values)
        reached = State(session.get_one(JobRow, claim.job_id, populate_existing=True).state)
        events.append(session, claim.job_id, [events.state_event(reached)])
        return reached


def expire(store: Store, backoff: float) -> list[str]:
    """Take jobs from workers whose lease has run out; returns the ids that wait again."""
    return _take_back(store, JobRow.lease_until < db_now(), "the worker fell silent", backoff)


def reclaim(store: Store, dead_owners: list[str]) -> list[str]:
    """Take jobs from workers that are known to be dead, without waiting for their leases."""
    return _take_back(store, JobRow.lease_owner.in_(dead_owners), "the worker died", 0.0)


def _take_back(store: Store, condition: ColumnElement[bool], reason: str, backoff: float) -> list[str]:
    waiting: list[str] = []
    with store.write() as session:
        lost = select(JobRow).where((JobRow.state == State.RUNNING) & condition).with_for_update(skip_locked=True)
        for row in session.scalars(lost).all():
            message = f"{reason}: {row.lease_owner}, attempt {row.attempt}, step {row.step} of {row.steps}"
            values = _after_failure(row, backoff, retry=True)
            error = {"error_kind": str(Failure.INFRASTRUCTURE), "error": message} if row.error is None else {}
            claim = Claim(row.id, row.attempt, row.spec, row.subject)
            _fenced(session, claim, values | error)
            events.append(session, row.id, [Event("state", {"state": str(values["state"]), "reason": message})])
            if values["state"] is State.QUEUED:
                waiting.append(row.id)
    return waiting


def owners(store: Store) -> list[str]:
    """Owners of the running jobs."""
    with store.read() as session:
        query = select(JobRow.lease_owner).where(JobRow.state == State.RUNNING, JobRow.lease_owner.is_not(None))
        return [str(owner) for owner in session.scalars(query.distinct())]


def unclaimed(store: Store, seconds: float, limit: int) -> list[str]:
    """Jobs that could have started ``seconds`` ago, most urgent first: their wake-up may be lost."""
    since = case((JobRow.not_before > JobRow.created_at, JobRow.not_before), else_=JobRow.created_at)
    query = select(JobRow.id).where(DUE, since <= db_now() - seconds)
    with store.read() as session:
        return list(session.scalars(query.order_by(JobRow.priority.desc(), JobRow.id).limit(limit)))


def take_duty(store: Store, name: str, owner: str, seconds: float) -> bool:
    """Take or renew a duty that one process at a time has. False: another has it."""
    with store.write() as session:
        free = (SchedulerRow.owner == owner) | (SchedulerRow.until < db_now())
        values = {"owner": owner, "until": db_now() + seconds}
        renewed = update(SchedulerRow).where(SchedulerRow.name == name, free).values(**values)
        if session.scalar(renewed.returning(SchedulerRow.name)) is not None:
            return True
        if session.get(SchedulerRow, name) is not None:
            return False
        session.execute(insert(SchedulerRow).values(name=name, **values))
        return True
