"""The service's own application on a free port of this machine, with a fresh database; and hands that play a worker."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import uvicorn

from services.api.app import create_app
from services.settings import Settings, make_home
from services.store import leases, schema
from services.store.records import Batch, Claim, Event, Failure, Outcome
from services.store.session import Store

OWNER = "test-worker"


@dataclass(frozen=True)
class Service:
    """Where it answers, and its database."""

    url: str
    store: Store

    def claim(self) -> Claim:
        """Take the next job, as a worker does."""
        claim = leases.claim(self.store, OWNER, 60.0)
        assert claim is not None
        return claim

    def say(self, claim: Claim, kind: str, **payload: object) -> None:
        """One event of a running job."""
        leases.beat(self.store, claim, Batch(events=[Event(kind, payload)]), 60.0)

    def succeed(self, claim: Claim, psnr: float) -> None:
        """End a job well."""
        means = {"psnr": psnr, "ssim": 0.8, "flip": 0.1, "lpips": None}
        provenance = {"commit": "abc1234", "data_sha256": "f" * 64}
        leases.succeed(self.store, claim, Outcome(means, {}, {"lpips": "weights absent"}, provenance, 7000, 12.0, 3.0))

    def fail(self, claim: Claim) -> None:
        """End a job badly, for good."""
        leases.fail(self.store, claim, Failure.BAD_DATA, "mask: expected a picture, got nothing", 0.0)


@contextmanager
def live_service(home: Path, *, require_token: bool = False) -> Iterator[Service]:
    """Serve until the block ends."""
    settings = Settings(home=home, poll_seconds=0.02, ping_seconds=0.1, require_token=require_token)
    make_home(settings)
    store = Store(settings)
    schema.migrate(store)
    config = uvicorn.Config(create_app(settings), log_level="error", ws="none", timeout_graceful_shutdown=1)
    server = uvicorn.Server(config)
    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = threading.Thread(target=server.run, args=([listener],), daemon=True)
        thread.start()
        while not server.started and thread.is_alive():
            time.sleep(0.01)
        try:
            yield Service(f"http://127.0.0.1:{listener.getsockname()[1]}", store)
        finally:
            server.should_exit = True
            thread.join(10)
            store.close()
