"""``python -m services.api``: the HTTP interface."""

from __future__ import annotations

import sys

import uvicorn
from fastapi import FastAPI

from services.api.app import create_app
from services.errors import ServiceError
from services.process import die_with_parent, share_arenas
from services.settings import Settings, make_home, read_settings
from services.store import tokens
from services.store.session import Store

STREAMS_SECONDS = 2  # open event streams are cut after this; clients resume them


def tell_first_token(settings: Settings) -> None:
    """Where tokens are asked for and nobody has one yet: issue the first, and say once where it is."""
    if not settings.needs_token:
        return
    store = Store(settings)
    try:
        if path := tokens.issue_first(store, settings.home):
            print(f"first admin token, in {path}: {path.read_text('utf-8').strip()}", flush=True)
    finally:
        store.close()


def one_of_several() -> FastAPI:
    """The application of one process among several that answer at the same address; it ends with their parent."""
    die_with_parent()
    share_arenas()
    return create_app(read_settings())


def main() -> int:
    """Serve until stopped."""
    share_arenas()
    try:
        settings = read_settings()
        make_home(settings)
        several = settings.api_processes > 1
        app = "services.api.__main__:one_of_several" if several else create_app(settings)
        tell_first_token(settings)
    except ServiceError as error:
        print(error, file=sys.stderr)
        return 1
    uvicorn.run(
        app,
        factory=several,
        workers=settings.api_processes,
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
