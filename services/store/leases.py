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
from services.store import artifacts, checkpoints, events, metrics, owners, reuse
from services.store.heartbeat import renewal
from services.store.records import Batch, Claim, Event, Failure, Look, Orders, Outcome, State
from services.store.session import Store, db_now
from services.store.tables import JobRow, SchedulerRow

LONGEST_BACKOFF = 300.0
LONGEST_TRACEBACK = 16_384  # characters; its end says most
UNSEEN = {"synchronize_session": False}  # rows in memory need not follow an UPDATE
IDLE = {"lease_owner": None, "lease_until": None, "cancel_requested_at": None, "pause_requested_at": None}
DUE = (JobRow.state == State.QUEUED) & (JobRow.not_before <= db_now())


def claim(store: Store, owner: str, lease_seconds: float) -> Claim | None:
    """Take the most urgent job of the owner whose turn it is; None when no job may run now.

    A job whose result has become known meanwhile is not taken but ends with it.
    """
    with store.write() as session:
        for name in owners.by_turn(session):
            if not owners.may_run(session, store, name):
                continue
            while (row := _first_due(session, name)) is not None:
                if reuse.adopt(session, row):
                    continue
                if (taken := _take(session, row, owner, lease_seconds)) is not None:
                    owners.note_served(session, name)
                    return taken
    return None


def _first_due(session: Session, name: str) -> JobRow | None:
    """In two look-ups of an index, highest priority first and then lowest id; rows that others hold are passed over."""
    due = (DUE, JobRow.owner == name, reuse.NO_TWIN_RUNS)
    top = session.scalar(select(JobRow.priority).where(*due).order_by(JobRow.priority.desc()).limit(1))
    if top is None:
        return None
    query = select(JobRow).where(*due, JobRow.priority == top).order_by(JobRow.id).limit(1)
    return session.scalar(query.with_for_update(skip_locked=True), execution_options={"populate_existing": True})


def _take(session: Session, row: JobRow, owner: str, lease_seconds: float) -> Claim | None:
    """Compare and set; None if somebody else was faster."""
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
    if taken is None:
        return None
    events.append(session, row.id, [events.state_event(State.RUNNING, attempt=taken)])
    return Claim(row.id, taken, row.spec, row.subject)


def beat(store: Store, claim: Claim, batch: Batch, lease_seconds: float) -> Orders:
    """Renew the lease, store ``batch``, and bring back what users asked for.

    Raises:
        FencedError: if the job was given away; nothing of ``batch`` is stored.
    """
    values = _columns(batch.look) | ({} if batch.rss_bytes is None else {"rss_bytes": batch.rss_bytes})
    who = {"of_job": claim.job_id, "of_attempt": claim.attempt, "for_seconds": lease_seconds}
    said = {f"new_{name}": value for name, value in values.items()}
    with store.write() as session:
        asked = _orders(session.execute(renewal(tuple(values)), who | said).one_or_none(), claim)
        events.append(session, claim.job_id, batch.events)
        metrics.put_points(session, claim.job_id, batch.points)
        artifacts.put(session, claim.job_id, batch.artifacts)
        if batch.checkpoint is not None:
            checkpoints.put(session, claim, batch.checkpoint)
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
    return _orders(session.execute(change, execution_options=UNSEEN).one_or_none(), claim)


def _orders(row: Any, claim: Claim) -> Orders:
    if row is None:
        raise FencedError("attempt", f"the running attempt of job {claim.job_id}", claim.attempt)
    return Orders(row[0] is not None, row[1] is not None)


def succeed(store: Store, claim: Claim, outcome: Outcome, content_sha256: str | None = None) -> None:
    """End a job with its result: state, result, scores and artifacts in one transaction, that of waiting twins as well.

    ``content_sha256`` is of what was really used, where that is known; data may have changed since the submission.

    Raises:
        FencedError: if the job was given away; nothing is stored.
    """
    columns = {"psnr": outcome.means.get("psnr"), "gaussians": outcome.gaussians, "eta_seconds": 0.0}
    ended = {"finished_at": db_now(), "error": None, "error_kind": None}
    content = {} if content_sha256 is None else {"content_sha256": content_sha256}
    with store.write() as session:
        _fenced(session, claim, {"state": State.SUCCEEDED, **ended, **IDLE, **columns, **content})
        metrics.put_outcome(session, claim, outcome)
        artifacts.put(session, claim.job_id, outcome.artifacts)
        checkpoints.forget(session, claim.job_id)
        events.append(session, claim.job_id, [events.state_event(State.SUCCEEDED, means=dict(outcome.means))])
        reuse.adopt_followers(session, claim.job_id)


def fail(store: Store, claim: Claim, kind: Failure, message: str, backoff: float, traceback: str = "") -> State:
    """End an attempt badly. Infrastructure failures wait and try again until the attempts are used up, then ``dead``.

    Of several failures the first message and the first traceback are kept on the job: they are the ones that explain.

    Raises:
        FencedError: if the job was given away.
    """
    retry = kind is Failure.INFRASTRUCTURE
    with store.write() as session:
        row = session.get_one(JobRow, claim.job_id)
        keep = retry and row.error is not None
        values: dict[str, Any] = {} if keep else {"error_kind": str(kind), "error": message}
        if row.first_traceback is None and traceback:
            values["first_traceback"] = traceback[-LONGEST_TRACEBACK:]
        values |= _after_failure(row, backoff, retry=retry)
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
            message += "" if row.rss_bytes is None else f", {row.rss_bytes >> 20} MB resident"
            values = _after_failure(row, backoff, retry=True)
            error = {"error_kind": str(Failure.INFRASTRUCTURE), "error": message} if row.error is None else {}
            claim = Claim(row.id, row.attempt, row.spec, row.subject)
            _fenced(session, claim, values | error)
            events.append(session, row.id, [Event("state", {"state": str(values["state"]), "reason": message})])
            if values["state"] is State.QUEUED:
                waiting.append(row.id)
    return waiting


def holders(store: Store) -> list[str]:
    """Workers that hold the leases of the running jobs."""
    with store.read() as session:
        query = select(JobRow.lease_owner).where(JobRow.state == State.RUNNING, JobRow.lease_owner.is_not(None))
        return [str(owner) for owner in session.scalars(query.distinct())]


def unclaimed(store: Store, seconds: float, limit: int) -> list[str]:
    """Jobs that could have started ``seconds`` ago, most urgent first: their wake-up may be lost."""
    since = case((JobRow.not_before > JobRow.created_at, JobRow.not_before), else_=JobRow.created_at)
    query = select(JobRow.id).where(DUE, since <= db_now() - seconds)
    with store.read() as session:
        return list(session.scalars(query.order_by(JobRow.priority.desc(), JobRow.id).limit(limit)))


def take_duty(store: Store, name: str, owner: str, seconds: float, *, renew: bool = True) -> bool:
    """Take a duty that one process at a time has, or renew one's own. False: somebody has it."""
    with store.write() as session:
        over = SchedulerRow.until < db_now()
        free = (SchedulerRow.owner == owner) | over if renew else over
        values = {"owner": owner, "until": db_now() + seconds}
        renewed = update(SchedulerRow).where(SchedulerRow.name == name, free).values(**values)
        if session.scalar(renewed.returning(SchedulerRow.name)) is not None:
            return True
        if session.get(SchedulerRow, name) is not None:
            return False
        session.execute(insert(SchedulerRow).values(name=name, **values))
        return True
