"""``python -m services.api``: the HTTP interface."""

from __future__ import annotations

import sys

import uvicorn

from services.api.app import create_app
from services.errors import ServiceError
from services.settings import make_home, read_settings

STREAMS_SECONDS = 2  # open event streams are cut after this; clients resume them


def main() -> int:
    """Serve until stopped."""
    try:
        settings = read_settings()
        settings.require_safe_bind()
        make_home(settings)
        app = create_app(settings)
    except ServiceError as error:
        print(error, file=sys.stderr)
        return 1
    uvicorn.run(
        app,
        host=settings.host,
        port=settings.port,
        timeout_graceful_shutdown=STREAMS_SECONDS,
        server_header=False,
        proxy_headers=False,
        access_log=False,
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
