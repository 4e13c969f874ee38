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
EXAMPLES = 4  # of every operation; RSAVATAR's nightly runs take more by --hypothesis-profile


@pytest.fixture
def described(settings: Settings, store: Store) -> Iterator[tuple[OpenApiSchema, str]]:
    """The description, and where the service answers."""
    app = create_app(settings)
    with serving(settings, app) as client:
        document = client.get(f"{PREFIX}/openapi.json").json()
        yield schemathesis.openapi.from_dict(document), str(client.base_url).rstrip("/")


def test_no_request_makes_the_service_fail(described: tuple[OpenApiSchema, str]) -> None:
    schema, url = described
    session = requests.Session()
    session.trust_env = False
    tried: dict[str, int] = {}

    def send(case: Case) -> None:
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
