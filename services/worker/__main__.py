"""``python -m services.worker``: the worker. With ``--check``: exit 0 if the worker of this host is alive."""

from __future__ import annotations

import sys
import time

from services.errors import ServiceError
from services.settings import Settings, make_home, read_settings
from services.worker.app import serve
from services.worker.sweep import alive_file

STALE_ROUNDS = 6


def is_alive(settings: Settings) -> bool:
    """Whether the worker of this host has swept lately."""
    file = alive_file(settings)
    return file.exists() and time.time() - file.stat().st_mtime < STALE_ROUNDS * settings.sweep_seconds + 10.0


def main() -> int:
    """Run the worker, or check it."""
    try:
        settings = read_settings()
        if "--check" in sys.argv[1:]:
            return 0 if is_alive(settings) else 1
        make_home(settings)
        serve(settings)
    except ServiceError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
