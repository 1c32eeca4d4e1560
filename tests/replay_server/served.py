"""A replay server that others reach by its socket."""

import socket
import ssl
import threading
from pathlib import Path

from rmc.common.bus.memory_bus import MemoryBus
from rmc.learner.replay.client import ReplayClient
from rmc.learner.replay.connection import ReplayConnection
from rmc.replay_server.config import ReplayConfig
from rmc.replay_server.server import ReplayServer
from rmc.replay_server.socket_server import SocketServer
from tests.replay_server.support import SPEC, Sender
from tests.waiting import wait_until

SECRET = b"a secret of the run"
MAX_BATCH = 4096
BIG = MAX_BATCH * (SPEC.dtype.itemsize + 8)


class Served:
    """A replay server with its socket, polled by a thread."""

    def __init__(
        self, folder: Path, address: str, config: ReplayConfig, windows: int, total: int = 10**9,
        secret: bytes = SECRET, tls: ssl.SSLContext | None = None,
    ) -> None:  # fmt: skip
        bus = MemoryBus()
        self.replay = ReplayServer(SPEC, config, folder, 3, total, 1, 64, bus)
        self.sender = Sender(bus)
        self.sender.send(windows)
        while self.replay.step():
            pass
        self.sockets = SocketServer(self.replay, address, secret, MAX_BATCH, tls)
        self.address = self.sockets.address
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._loop)
        self._thread.start()

    def _loop(self) -> None:
        while not self._stop.is_set():
            self.sockets.wait(0.01)
            self.sockets.poll()

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self.sockets.close()
        self.replay.close()

    def connect(self, secret: bytes = SECRET, epoch: int = 0) -> ReplayConnection:
        return ReplayConnection(self.address, secret, SPEC.fingerprint, BIG, epoch=epoch)

    def client(self, epoch: int) -> ReplayClient:
        """A learner's end."""
        client = ReplayClient(lambda: self.address, SECRET, SPEC, 8)
        client.register_learner(epoch)
        return client

    def stranger(self) -> socket.socket:
        """A raw connection that has got its challenge and said nothing."""
        raw = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        raw.settimeout(5.0)
        raw.connect(self.address.removeprefix("unix:"))
        raw.recv(4096)
        return raw

    def refused(self, reason: str) -> None:
        """Wait until a client was sent away for this reason."""
        wait_until(lambda: self.sockets.refused[reason], 5.0, lambda: dict(self.sockets.refused))
