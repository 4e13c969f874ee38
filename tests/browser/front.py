"""One address before several servers: every connection goes to the next one, as a plain load balancer does it."""

from __future__ import annotations

import contextlib
import itertools
import socket
import threading
from collections import Counter
from collections.abc import Sequence

BLOCK = 1 << 16


class Front:
    """Listens on loopback and splices connections to ``ports`` in turn; ``served`` counts them."""

    def __init__(self, ports: Sequence[int]) -> None:
        self._turn = itertools.cycle(ports)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        self.url = f"http://127.0.0.1:{self.port}"
        self.served: Counter[int] = Counter()
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self._listener.accept()
            except OSError:  # closed
                return
            port = next(self._turn)
            try:
                server = socket.create_connection(("127.0.0.1", port))
            except OSError:
                client.close()
                continue
            self.served[port] += 1
            for source, target in ((client, server), (server, client)):
                threading.Thread(target=_splice, args=(source, target), daemon=True).start()

    def close(self) -> None:
        """Take no more connections."""
        self._listener.close()


def _splice(source: socket.socket, target: socket.socket) -> None:
    with contextlib.suppress(OSError):
        while block := source.recv(BLOCK):
            target.sendall(block)
    for end in (source, target):
        with contextlib.suppress(OSError):
            end.shutdown(socket.SHUT_RDWR)
        end.close()
