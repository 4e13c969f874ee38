"""``python -m services.gc [--dry-run]``: remove stored bytes that nothing names any more.

The workers do the same by themselves every RSAVATAR_GC_HOURS; this is for looking, and for a full disk.
"""

from __future__ import annotations

import argparse
import sys

from services.errors import ServiceError
from services.settings import make_home, read_settings
from services.store import garbage, schema
from services.store.session import Store


def parser() -> argparse.ArgumentParser:
    """The command line."""
    words = argparse.ArgumentParser("services.gc", description=__doc__.partition("\n\n")[0])
    words.add_argument("--dry-run", action="store_true", help="only say what would be removed")
    words.add_argument("--grace", type=float, metavar="SECONDS", help="least age (default: RSAVATAR_GC_GRACE_SECONDS)")
    return words


def main() -> int:
    """Collect once and print what was found."""
    options = parser().parse_args()
    try:
        settings = read_settings()
        make_home(settings)
        store = Store(settings)
        schema.require_head(store)
        grace = settings.gc_grace_seconds if options.grace is None else options.grace
        found = garbage.collect(store, settings.home / "jobs", grace, dry_run=options.dry_run)
        store.close()
    except ServiceError as error:
        print(error, file=sys.stderr)
        return 1
    verb = "would remove" if options.dry_run else "removed"
    print(f"{verb} {found.blobs} blobs ({found.bytes / 2**20:.1f} MB), {found.strays} unfinished files,")
    print(f"{found.folders} folders of jobs that do not exist")
    for sha256 in found.missing:
        print(f"missing: the bytes of {sha256} are named but gone")
    return 0


if __name__ == "__main__":
    sys.exit(main())
