"""How often one caller may ask: token buckets in the broker's Redis, shared by all replicas of the API.

Without Redis each process counts for itself, so that a limit never becomes an outage.
"""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass

import redis
from redis.backoff import NoBackoff
from redis.retry import Retry

from services.settings import Settings

KEY = "rsavatar:limit:"
TIMEOUT_SECONDS = 0.5
AWAY_SECONDS = 5.0  # after a failure Redis is not asked for this long
MOST_LOCAL = 10_000  # buckets that one process remembers
SCRIPT = """
local time = redis.call('TIME')
local now = time[1] + time[2] / 1000000
local rate, burst = tonumber(ARGV[1]), tonumber(ARGV[2])
local held = redis.call('HMGET', KEYS[1], 'left', 'at')
local left = math.min(burst, (tonumber(held[1]) or burst) + (now - (tonumber(held[2]) or now)) * rate)
local wait = 0
if left >= 1 then left = left - 1 else wait = (1 - left) / rate end
redis.call('HSET', KEYS[1], 'left', tostring(left), 'at', tostring(now))
redis.call('EXPIRE', KEYS[1], math.ceil(burst / rate) + 1)
return tostring(wait)
"""


@dataclass(frozen=True)
class Pace:
    """``burst`` requests at once, then ``rate`` per second."""

    rate: float
    burst: float


class Limiter:
    """Buckets by name. Threads may share it."""

    def __init__(self, settings: Settings) -> None:
        self._client = _client(settings)
        self._script = None if self._client is None else self._client.register_script(SCRIPT)
        self._away_until = 0.0
        self._lock = threading.Lock()
        self._local: dict[str, tuple[float, float]] = {}

    def wait(self, name: str, pace: Pace) -> float:
        """Take one from the bucket ``name``: 0 when there was one, else the seconds until there is."""
        if self._script is not None and time.monotonic() > self._away_until:
            try:
                return float(self._script(keys=[KEY + name], args=[pace.rate, pace.burst]))
            except redis.RedisError:
                self._away_until = time.monotonic() + AWAY_SECONDS
        return self._wait_here(name, pace)

    def _wait_here(self, name: str, pace: Pace) -> float:
        now = time.monotonic()
        with self._lock:
            if len(self._local) > MOST_LOCAL:
                self._local.clear()
            left, at = self._local.get(name, (pace.burst, now))
            left = min(pace.burst, left + (now - at) * pace.rate)
            self._local[name] = (left - 1 if left >= 1 else left, now)
        return 0.0 if left >= 1 else (1 - left) / pace.rate

    def close(self) -> None:
        """Give the connections back."""
        if self._client is not None:
            self._client.close()


def _client(settings: Settings) -> redis.Redis | None:
    url = settings.broker
    once = Retry(NoBackoff(), 0)  # the library would try again for seconds, with a request waiting
    quick = TIMEOUT_SECONDS
    if url.startswith("redis+socket://"):
        path = url.removeprefix("redis+socket://").partition("?")[0]
        return redis.Redis(unix_socket_path=path, socket_timeout=quick, socket_connect_timeout=quick, retry=once)
    if url.startswith(("redis://", "rediss://")):
        return redis.Redis.from_url(url, socket_timeout=quick, socket_connect_timeout=quick, retry=once)
    return None
