"""``python -m services.renderer FD IDLE``: answers orders on an inherited socket until its other end is closed.

An order is one message of JSON. The answer is a message of JSON, ``{"mime": ...}`` and then a message of bytes, or
``{"error": KIND, "message": ...}`` alone. After ``IDLE`` seconds without an order the process ends, and its memory with
it; the API starts another one when it needs one.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import traceback
from multiprocessing.connection import Connection

from rsavatar.errors import RsAvatarError, SpecError
from services.renderer.orders import Desk

LARGEST_ORDER = 64 << 20


def serve(connection: Connection, idle: float, desk: Desk) -> int:
    """Answer until the other end closes or nothing was asked for ``idle`` seconds."""
    while connection.poll(idle):
        try:
            order = json.loads(connection.recv_bytes(LARGEST_ORDER))
        except EOFError:
            break
        try:
            mime, data = desk.answer(order)
        except Exception as error:
            kind = "spec" if isinstance(error, SpecError) else "data" if isinstance(error, RsAvatarError) else "bug"
            if kind == "bug":
                traceback.print_exc()
            connection.send_bytes(json.dumps({"error": kind, "message": str(error)}).encode())
            continue
        connection.send_bytes(json.dumps({"mime": mime}).encode())
        connection.send_bytes(data)
    return 0


def main() -> int:
    """Read the arguments and serve."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole terminal; the API decides
    threads = int(os.environ.get("RSAVATAR_THREADS", "1"))
    return serve(Connection(int(sys.argv[1])), float(sys.argv[2]), Desk(threads))


if __name__ == "__main__":
    sys.exit(main())
