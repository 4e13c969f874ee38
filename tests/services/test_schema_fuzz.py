"""Requests made up from the interface's own description: whatever they ask for, the answer is no failure of ours."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import requests
import schemathesis
from hypothesis import HealthCheck, Phase, given
from hypothesis import settings as pace
from schemathesis import Case
from schemathesis.core.result import Ok
from schemathesis.specs.openapi.schemas import OpenApiSchema

from services.api.app import PREFIX, create_app
from services.settings import Settings
from services.store.session import Store
from tests.services.conftest import serving

ENDLESS = ("/events",)  # streams that end with their reader
EXAMPLES = 6  # of every operation; 40 of each have been tried by hand
JOB = {"method": "gauhuman", "subject": "studio", "preset": "smoke"}


@pytest.fixture
def described(settings: Settings, store: Store) -> Iterator[tuple[OpenApiSchema, str, str]]:
    """The description, where the service answers, and a job that it has."""
    app = create_app(settings)
    with serving(settings, app) as client:
        document = client.get(f"{PREFIX}/openapi.json").json()
        job = client.post(f"{PREFIX}/jobs", json=JOB).json()["id"]
        yield schemathesis.openapi.from_dict(document), str(client.base_url).rstrip("/"), job


def deepen(case: Case, job: str) -> None:
    """Name what exists, so that what lies behind the first check is reached too."""
    if "job_id" in (case.path_parameters or {}):
        case.path_parameters["job_id"] = job
    if isinstance(case.body, dict) and "method" in case.body:
        case.body.update(JOB)
    if isinstance(case.body, dict) and "base" in case.body:
        case.body["base"] = JOB


def test_no_request_makes_the_service_fail(described: tuple[OpenApiSchema, str, str]) -> None:
    schema, url, job = described
    session = requests.Session()
    session.trust_env = False
    tried: dict[str, int] = {}

    def send(case: Case) -> None:
        if tried.get(case.operation.label, 0) % 2:
            deepen(case, job)
        reply = case.call(base_url=url, session=session, timeout=20)
        what = f"{case.method} {case.formatted_path}: {reply.status_code} {reply.content[:300]!r}"
        assert reply.status_code < 500, what
        if reply.status_code >= 400:
            assert reply.headers["content-type"][0].startswith("application/problem+json"), what
        tried[case.operation.label] = tried.get(case.operation.label, 0) + 1

    for result in schema.get_all_operations():
        assert isinstance(result, Ok), result
        operation = result.ok()
        if operation.path.endswith(ENDLESS):
            continue
        few = pace(
            max_examples=EXAMPLES,
            deadline=None,
            derandomize=True,
            database=None,
            phases=(Phase.generate,),
            suppress_health_check=list(HealthCheck),
        )
        few(given(case=operation.as_strategy())(send))()
    assert len(tried) > 20
