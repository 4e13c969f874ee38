from __future__ import annotations

from collections.abc import Iterator

import pytest

from services.demo import free_port
from tests.system.harness import Host


@pytest.fixture(scope="session")
def host(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Host]:
    host = Host(tmp_path_factory.mktemp("host"), free_port())
    for name in ("redis", "api", "worker"):
        host.start(name)
    yield host
    host.close()
