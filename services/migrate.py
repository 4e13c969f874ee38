"""``python -m services.migrate``: bring the database to the version of this code, once, before anything starts."""

from __future__ import annotations

import sys

from services.errors import ServiceError
from services.settings import make_home, read_settings
from services.store import schema
from services.store.session import Store


def main() -> int:
    """Migrate the database of the environment's settings; the exit status is 0 when it is at its head."""
    try:
        settings = read_settings()
        make_home(settings)
        store = Store(settings)
        schema.migrate(store)
        print(f"database is at version {schema.current(store)}")
        store.close()
    except ServiceError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
