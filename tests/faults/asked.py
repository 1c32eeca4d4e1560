"""A replay server's socket and its only client in one thread, for messages that may be anything."""

import socket
import tempfile
from contextlib import suppress
from pathlib import Path

import msgpack
from isal.isal_zlib import crc32

from rmc.common.bus.memory_bus import MemoryBus
from rmc.common.errors import MessageError
from rmc.common.wire import HEADER, MAGIC, VERSION, Kind
from rmc.common.wire import proof as proof_of
from rmc.replay_server.config import ReplayConfig
from rmc.replay_server.server import ReplayServer
from rmc.replay_server.socket_server import SocketServer
from tests.replay_server.support import SPEC, Sender

SECRET, NONCE = b"of this run", b"n" * 32
PROOF = b"p" * 32  # in whose place the right one is put
BATCH, EPOCH = 8, 2**62 - 1
LAWFUL_PROOF: bytes = msgpack.packb({"nonce": NONCE, "proof": PROOF, "epoch": EPOCH})


class Asked:
    """``known`` while the client is one that has proved itself and was not sent away."""

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="rmc-asked-")
        folder, bus = Path(self._folder.name), MemoryBus()
        config = ReplayConfig(capacity=100, replay_ratio=1e9, warmup_steps=0)
        server, sender = ReplayServer(SPEC, config, folder / "ring", 0, 10**6, 1, 100, bus), Sender(bus)
        sender.send(40)
        while server.step():
            pass
        self._path = str(folder / "asked.sock")
        self._server = SocketServer(server, f"unix:{self._path}", SECRET, BATCH)
        self._client = socket.socket(socket.AF_UNIX)
        self.known = False

    def connect(self) -> None:
        """Anew, as a stranger, who has the server's challenge."""
        self._client.close()
        self._client = socket.socket(socket.AF_UNIX)
        self._client.connect(self._path)
        self.known = False
        while not (raw := self._heard()):
            pass
        header = HEADER.unpack_from(raw)
        self._challenge = msgpack.unpackb(raw[HEADER.size : HEADER.size + header[4]])["nonce"]

    def prove(self) -> None:
        """That it is the newest learner."""
        self.say_proof(LAWFUL_PROOF)
        self.known = True

    def say_proof(self, meta: bytes) -> None:
        """With the right proof, as far as there is still a place for it. Raises MessageError."""
        self.say(Kind.PROOF, meta.replace(PROOF, proof_of(SECRET, b"client", self._challenge, NONCE)))

    def say(self, kind: Kind, meta: bytes, body: bytes = b"") -> None:
        """A frame whose lengths and checksum are right. Raises MessageError where the server sends its client away."""
        before = self._server.refused.copy()
        frame = HEADER.pack(MAGIC, VERSION, int(kind), 0, len(meta), crc32(body, crc32(meta)), len(body))
        self._client.sendall(frame + meta + body)
        self._heard()
        if reasons := self._server.refused - before:
            self.known = False
            raise MessageError(" ".join(reasons))

    def _heard(self) -> bytes:
        """What the server answers at once."""
        while self._server.poll():
            with suppress(BlockingIOError):
                return self._client.recv(1 << 20, socket.MSG_DONTWAIT)
        return b""
