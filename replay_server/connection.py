"""One client's connection: bytes in, frames out, never blocking."""

import selectors
import socket
import ssl
import time
from collections import deque
from collections.abc import Mapping
from typing import Any, NamedTuple

from rmc.common.errors import MessageError
from rmc.common.shared_batches import SharedBatches
from rmc.common.wire import HEADER, FrameHeader, Kind, decode_header, decode_meta, encode_frame

RECEIVE_BYTES = 64 << 10
STRANGER_META_BYTES = 1024  # all that someone who has not proved anything may make us hold


class Frame(NamedTuple):
    """A frame received whole, its CRC checked."""

    kind: Kind
    meta: dict[str, Any]
    body: bytes


class ClientConnection:
    """Buffers of one non-blocking socket. OSError from any method means: it is gone."""

    def __init__(self, connection: socket.socket, challenge: bytes) -> None:
        connection.setblocking(False)
        self.socket, self.challenge = connection, challenge
        self.encrypted = not isinstance(connection, ssl.SSLSocket)  # or need not be
        self.authenticated, self.epoch = False, 0  # and of which learner
        self.nonce = b""  # of a client that has shown its proof
        self.opened = time.monotonic()
        self._inbox = bytearray()
        self._unsent: deque[memoryview] = deque()
        self.shared: SharedBatches | None = None  # where its batches lie, if not in the socket
        self._zero_copy = False  # unsent frames may hold views of the sender's buffers

    @property
    def sending(self) -> bool:
        """Whether something is still to be sent; until then no frame of this client is handled."""
        return bool(self._unsent)

    def events(self, ahead: int) -> int:
        """What to wait for. A client may send ``ahead`` bytes before it reads: else each may wait for the other."""
        if not self._unsent:
            return selectors.EVENT_READ
        return selectors.EVENT_WRITE | (selectors.EVENT_READ if len(self._inbox) < ahead else 0)

    def encrypt(self) -> bool:
        """Go on with the handshake of a socket that needs one; whether it is over."""
        assert isinstance(self.socket, ssl.SSLSocket)
        try:
            self.socket.do_handshake()
        except (ssl.SSLWantReadError, ssl.SSLWantWriteError):
            return False
        self.encrypted = True
        return True

    def receive(self) -> None:
        """Take what has arrived, at most 64 KiB, and what of it is decrypted already."""
        try:
            received = self.socket.recv(RECEIVE_BYTES)
            while received and isinstance(self.socket, ssl.SSLSocket) and (pending := self.socket.pending()):
                received += self.socket.recv(pending)
        except (BlockingIOError, ssl.SSLWantReadError):
            return
        if not received:
            raise ConnectionError("closed by the client")
        self._inbox += received

    def next_frame(self, max_body: int) -> Frame | None:
        """The next frame that is here whole. Raises MessageError, sizes checked before their bytes are awaited."""
        if len(self._inbox) < HEADER.size:
            return None
        header = decode_header(bytes(self._inbox[: HEADER.size]), max_body)
        if not self.authenticated and header.meta_length > STRANGER_META_BYTES:
            raise MessageError("too-large", f"meta {header.meta_length} before authentication")
        if len(self._inbox) < HEADER.size + header.meta_length + header.body_length:
            return None
        return self._take(header)

    def _take(self, header: FrameHeader) -> Frame:
        split = HEADER.size + header.meta_length
        end = split + header.body_length
        raw_meta, body = bytes(self._inbox[HEADER.size : split]), bytes(self._inbox[split:end])
        del self._inbox[:end]
        return Frame(header.kind, decode_meta(raw_meta, body, header), body)

    def send(self, kind: Kind, meta: Mapping[str, Any], parts: tuple[memoryview, ...] = ()) -> None:
        """Send what the kernel takes now and keep the rest, without a copy: see ``copy_pending``."""
        self._unsent += [memoryview(encode_frame(kind, meta, parts)), *(part for part in parts if part.nbytes)]
        self._zero_copy = True
        self.flush()

    def send_descriptor(self, kind: Kind, descriptor: int) -> None:
        """Send an empty frame and a file descriptor with it."""
        frame = encode_frame(kind, {})
        sent = socket.send_fds(self.socket, [frame], [descriptor])
        self._unsent += [memoryview(frame[sent:])] * (sent < len(frame))

    def flush(self) -> None:
        """Go on sending."""
        while self._unsent:
            try:
                sent = self._send_some()
            except (BlockingIOError, ssl.SSLWantWriteError, ssl.SSLWantReadError):
                return
            while self._unsent and sent >= self._unsent[0].nbytes:
                sent -= self._unsent.popleft().nbytes
            if self._unsent:
                self._unsent[0] = self._unsent[0][sent:]

    def _send_some(self) -> int:
        if isinstance(self.socket, ssl.SSLSocket):  # which cannot gather
            return self.socket.send(self._unsent[0])
        return self.socket.sendmsg(self._unsent)

    def copy_pending(self) -> None:
        """Copy what is still unsent, because its buffer is about to be used again."""
        if self._zero_copy:
            self._unsent = deque(memoryview(bytes(part)) for part in self._unsent)
            self._zero_copy = False

    def close(self) -> None:
        self.socket.close()
