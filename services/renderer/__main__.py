"""``python -m services.renderer FD IDLE``: answers orders on an inherited socket until its other end is closed.
``python -m services.renderer PATH``: the same for whoever connects to a unix socket, until it is stopped; for an API
that has no numeric core beside it (RSAVATAR_RENDER_SOCKET).

An order is one message of JSON. The answer is a message of JSON, ``{"mime": ...}`` and then a message of bytes, or
``{"error": KIND, "message": ...}`` alone. After ``IDLE`` seconds without an order the process ends, and its memory with
it; the API starts another one when it needs one.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import traceback
from multiprocessing.connection import Connection, Listener
from pathlib import Path

from rsavatar.errors import RsAvatarError, SpecError
from services.renderer.orders import Desk

LARGEST_ORDER = 64 << 20
TURN = threading.Lock()  # one drawing at a time: it uses all threads by itself


def serve(connection: Connection, idle: float | None, desk: Desk) -> int:
    """Answer until the other end closes or nothing was asked for ``idle`` seconds; None is patient."""
    while connection.poll(idle):
        try:
            order = json.loads(connection.recv_bytes(LARGEST_ORDER))
        except EOFError:
            break
        try:
            with TURN:
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


def listen(path: Path, desk: Desk) -> None:
    """Serve everybody who connects to ``path``, each in a thread; orders take turns at the desk."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    with Listener(str(path), "AF_UNIX") as listener:
        path.chmod(0o600)
        while True:
            threading.Thread(target=serve, args=(listener.accept(), None, desk), daemon=True).start()


def main() -> int:
    """Read the arguments and serve."""
    desk = Desk(int(os.environ.get("RSAVATAR_THREADS", "1")))
    if len(sys.argv) == 2:
        listen(Path(sys.argv[1]), desk)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole terminal; the API decides
    return serve(Connection(int(sys.argv[1])), float(sys.argv[2]), desk)


if __name__ == "__main__":
    sys.exit(main())
