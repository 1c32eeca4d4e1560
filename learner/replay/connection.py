"""A connection to a replay server that has proved that it knows the run's secret. Frames: ``common/wire.py``."""

import os
import socket
import ssl
from contextlib import suppress
from typing import Any, NoReturn

from rmc.common.errors import AuthenticationError, FencedError, MessageError
from rmc.common.shared_batches import SharedBatches
from rmc.common.window import WindowSpec
from rmc.common.wire import (
    HEADER,
    NONCE_BYTES,
    FrameHeader,
    Kind,
    decode_header,
    decode_meta,
    encode_frame,
    is_proof,
    proof,
)

TIMEOUT = 10.0  # seconds until a silent server counts as gone
RECEIVE_BUFFER = 8 << 20


class ReplayConnection:
    """One authenticated connection. Blocking, with a timeout."""

    def __init__(
        self,
        address: str,
        secret: bytes,
        fingerprint: str,
        max_body: int,
        tls: ssl.SSLContext | None = None,
        epoch: int = 0,
    ) -> None:
        """``address``: ``unix:PATH`` or ``tcp:HOST:PORT``; ``epoch``: the learner's.

        Raises OSError, MessageError, AuthenticationError, FencedError.
        """
        self._max_body = max_body
        self._socket = _connect(address, tls)
        self._reader = self._socket.makefile("rb")  # a small frame comes by one call
        self._unsent: list[bytes | memoryview] = []
        try:
            self._authenticate(secret, fingerprint, epoch)
        except BaseException:
            self.close()
            raise

    def _authenticate(self, secret: bytes, fingerprint: str, epoch: int) -> None:
        header, meta = self.receive_small()
        challenge = meta.get("nonce")
        if header.kind is not Kind.CHALLENGE or not isinstance(challenge, bytes):
            raise AuthenticationError("the replay server sent no challenge")
        nonce = os.urandom(NONCE_BYTES)
        self._fenced = proof(secret, b"fenced", nonce, challenge)
        self.send(Kind.PROOF, {"nonce": nonce, "proof": proof(secret, b"client", challenge, nonce), "epoch": epoch})
        header, meta = self.receive_small()
        if header.kind is Kind.ERROR:
            self._check_not_fenced(meta)
            raise AuthenticationError(f"it said {meta.get('error')!r:.200}")
        authentic = is_proof(meta.get("proof"), proof(secret, b"server", nonce, challenge))
        if header.kind is not Kind.WELCOME or not authentic:
            raise AuthenticationError("the replay server does not know this run's secret")
        if meta.get("fingerprint") != fingerprint:
            raise MessageError("fingerprint", f"{meta.get('fingerprint')}, this learner has {fingerprint}")

    def _check_not_fenced(self, meta: dict[str, Any]) -> None:
        """It ends the learner, so it is believed with a proof for this connection alone, at any time of it."""
        if is_proof(meta.get("fenced"), self._fenced):
            raise FencedError(str(meta.get("error")))

    def raise_error(self, meta: dict[str, Any]) -> NoReturn:
        """What an ERROR of a server that has proved itself says."""
        self._check_not_fenced(meta)
        raise MessageError("replay", f"{meta.get('error')!s:.200}")

    def send(self, kind: Kind, meta: dict[str, Any], parts: tuple[bytes | memoryview, ...] = ()) -> None:
        """Send a frame whose body is the parts in order, after what is enqueued."""
        self.enqueue(kind, meta, parts)
        self.flush()

    def flush(self) -> None:
        """Send what is enqueued."""
        if self._unsent:
            self._socket.sendall(b"".join(self._unsent))
            self._unsent.clear()

    def enqueue(self, kind: Kind, meta: dict[str, Any], parts: tuple[bytes | memoryview, ...]) -> None:
        """Let a frame go with the next that is sent: the server is woken once for both."""
        self._unsent += [encode_frame(kind, meta, parts), *parts]

    def share(self, spec: WindowSpec, batch_size: int) -> SharedBatches | None:
        """Memory in which the server puts batches from now on; None where it shares none."""
        self.send(Kind.SHARE, {"batch_size": batch_size})
        raw, descriptors, _, _ = socket.recv_fds(self._socket, HEADER.size, 1)
        try:
            header = decode_header(raw + self._exactly(HEADER.size - len(raw)), 0)
            meta = decode_meta(self._exactly(header.meta_length), b"", header)
            if header.kind is not Kind.SHARE:
                self.raise_error(meta)
            return SharedBatches(descriptors[0], spec, batch_size) if descriptors else None
        finally:
            for descriptor in descriptors:
                os.close(descriptor)

    def receive(self, body_buffer: memoryview) -> tuple[FrameHeader, dict[str, Any], memoryview]:
        """The next frame, its body in the buffer given. Raises MessageError, OSError."""
        header = decode_header(self._exactly(HEADER.size), min(self._max_body, len(body_buffer)))
        raw_meta = self._exactly(header.meta_length)
        body = body_buffer[: header.body_length]
        self._fill(body)
        return header, decode_meta(raw_meta, body, header), body

    def receive_small(self) -> tuple[FrameHeader, dict[str, Any]]:
        """The next frame, which has no body."""
        header, meta, _ = self.receive(memoryview(bytearray()))
        return header, meta

    def _exactly(self, length: int) -> bytes:
        raw = bytearray(length)
        self._fill(memoryview(raw))
        return bytes(raw)

    def _fill(self, view: memoryview) -> None:
        while len(view):
            received = self._reader.readinto(view)
            if not received:
                raise ConnectionError("the replay server closed the connection")
            view = view[received:]

    def close(self) -> None:
        self._reader.close()
        self._socket.close()


def _connect(address: str, tls: ssl.SSLContext | None) -> socket.socket:
    if "\0" in address:  # a socket would raise TypeError
        raise ValueError(f"{address!r:.200} is no address")
    scheme, _, rest = address.partition(":")
    host, _, port = rest.rpartition(":")
    target: Any = rest if scheme == "unix" else (host, int(port))
    connection = socket.socket(socket.AF_UNIX if scheme == "unix" else socket.AF_INET, socket.SOCK_STREAM)
    if scheme != "unix":
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    with suppress(OSError):  # macOS refuses more than its limit, Linux takes what it allows
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
    connection.settimeout(TIMEOUT)
    try:
        connection.connect(target)
        return connection if tls is None else tls.wrap_socket(connection)
    except BaseException:
        connection.close()
        raise
