"""Fire: something of a deployment is killed every few seconds, in an order that a seed decides."""

from __future__ import annotations

import random
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable

import redis

from tests.system.harness import Host

WORKERS = ("worker", "worker-2")
LOOK_SECONDS = 0.5


class Fire:
    """Kills workers, the processes that train, the API, and the broker, which also loses its memory."""

    def __init__(self, host: Host, pause: float, seed: int) -> None:
        self.host = host
        self.pause = pause
        self.random = random.Random(seed)
        self.kills: Counter[str] = Counter()
        self.faults: list[Callable[[], str]] = [self.worker, self.child, self.worker, self.child, self.api, self.broker]

    def until(self, over: Callable[[], bool], says: Callable[[], str]) -> None:
        """A kill after every pause, until it is over; ``says`` is what is told beside it."""
        while not self._rest(over):
            if what := self.random.choice(self.faults)():
                self.kills[what.partition("-")[0]] += 1
                print(f"{time.strftime('%H:%M:%S')} killed {what}; {says()}", file=sys.stderr, flush=True)

    def _rest(self, over: Callable[[], bool]) -> bool:
        """Wait for the next kill; whether it is over before."""
        deadline = time.monotonic() + self.random.uniform(0.5, 1.5) * self.pause
        while not over():
            if (left := deadline - time.monotonic()) <= 0:
                return False
            time.sleep(min(left, LOOK_SECONDS))
        return True

    def worker(self) -> str:
        name = self.random.choice(WORKERS)
        self.host.kill(name)
        self.host.start(name)
        return name

    def child(self) -> str:
        children = self.host.children()
        if not children:
            return ""
        self.random.choice(children).send_signal(signal.SIGKILL)
        return "child"

    def api(self) -> str:
        self.host.kill("api")
        self.host.start("api")
        return "api"

    def broker(self) -> str:
        with redis.Redis(unix_socket_path=str(self.host.settings.socket)) as client:
            client.flushall()
        self.host.kill("redis")
        self.host.start("redis")
        return "redis with FLUSHALL"
