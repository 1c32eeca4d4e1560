"""The replay server's own socket: batches out and priorities in, by the frames of ``common/wire.py``.

Non-blocking throughout: a client that is silent, slow or lies costs at most its own connection. Both
sides prove that they know the run's secret before anything else is said:

    server -> CHALLENGE {nonce: c}
    client -> PROOF {nonce: n, proof: HMAC(secret, "client" + c + n), epoch: the learner's}
    server -> WELCOME {proof: HMAC(secret, "server" + n + c), fingerprint}
    server -> ERROR {fenced: HMAC(secret, "fenced" + n + c)} in its place or later, where a newer learner has come

Requests may be pipelined; each connection's are answered in order. A draw that the limiter holds back is
answered WAIT at once, and the client asks again.
"""

import contextlib
import logging
import os
import selectors
import socket
import ssl
import time
from collections import Counter
from typing import Any

import numpy as np

from rmc.common.errors import AuthenticationError, ConfigError, FencedError, MessageError
from rmc.common.replay import SampleStatus
from rmc.common.shared_batches import SharedBatches, reserve_memory, shared_bytes
from rmc.common.wire import NONCE_BYTES, Kind, is_proof, proof
from rmc.replay_server.connection import ClientConnection, Frame
from rmc.replay_server.listener import listen
from rmc.replay_server.server import ReplayServer

log = logging.getLogger(__name__)
MAX_CONNECTIONS = 32
AUTHENTICATION_SECONDS = 5.0
SEND_BUFFER = 8 << 20  # bytes: a batch should leave in one call
AHEAD_BYTES = 64  # that a client may send before it reads, for each window of a batch: the priorities of five batches
READ, WRITE = selectors.EVENT_READ, selectors.EVENT_WRITE


class SocketServer:
    """Serves a replay server at an address of ``listener.listen``; ``address`` afterwards names the port taken.

    With ``tls`` all is encrypted before the proofs. Raises ConfigError where it cannot be listened on.
    """

    def __init__(
        self,
        server: ReplayServer,
        address: str,
        secret: bytes,
        max_batch: int,
        tls: ssl.SSLContext | None = None,
    ) -> None:
        if not secret:
            raise ConfigError("secret", "", "the run's secret must not be empty")
        self._server, self._secret, self._max_batch, self._tls = server, secret, max_batch, tls
        self._listener, self._path, self.address = listen(address)
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, READ)
        self._connections: set[ClientConnection] = set()
        self._learner = 0  # the newest epoch that has introduced itself, or that the bus knows
        self.refused: Counter[str] = Counter()  # connections ended for a fault of theirs, by reason

    def wait(self, seconds: float) -> None:
        """Wait until somebody is ready, at most so long."""
        self._selector.select(seconds)

    def stay_reachable(self) -> None:
        """Listen again where others have removed the socket's file. Who is connected stays so."""
        if self._path is None or self._path.exists():
            return
        with contextlib.suppress(ConfigError):  # its folder is away, too; the next look tries again
            listener, *_ = listen(self.address)
            log.warning("%s was removed; it is made again", self._path)
            self._selector.unregister(self._listener)
            self._listener.close()
            self._listener = listener
            self._selector.register(listener, READ)

    def poll(self) -> bool:
        """Serve whoever is ready; whether there was anyone."""
        ready = self._selector.select(0.0)
        for key, events in ready:
            if key.data is None:
                self._accept()
            elif key.data in self._connections:  # not ended earlier in this round
                self._serve(key.data, events)
        self._end_unauthenticated()
        return bool(ready)

    def _accept(self) -> None:
        try:
            accepted, _ = self._listener.accept()
        except OSError:  # it went away again, or we are out of file handles
            return
        if len(self._connections) >= MAX_CONNECTIONS and not self._evict_oldest_unauthenticated():
            self.refused["too-many"] += 1
            accepted.close()
            return
        try:
            accepted = self._prepared(accepted)
        except OSError:  # it went away again, or has begun by something that is no handshake
            accepted.close()
            return
        connection = ClientConnection(accepted, os.urandom(NONCE_BYTES))
        self._connections.add(connection)
        self._selector.register(accepted, READ, connection)
        if connection.encrypted:
            try:
                connection.send(Kind.CHALLENGE, {"nonce": connection.challenge})
            except OSError:
                self._end(connection)

    def _evict_oldest_unauthenticated(self) -> bool:
        """Make room, so that a crowd of strangers keeps no client out; whether there was one to end."""
        unauthenticated = [connection for connection in self._connections if not connection.authenticated]
        if unauthenticated:
            self.refused["too-many"] += 1
            self._end(min(unauthenticated, key=lambda stranger: stranger.opened))
        return bool(unauthenticated)

    def _prepared(self, accepted: socket.socket) -> socket.socket:
        with contextlib.suppress(OSError):  # macOS refuses more than its limit, Linux takes what it allows
            accepted.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
        if accepted.family != socket.AF_UNIX:
            accepted.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            accepted.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        if self._tls is None:
            return accepted
        return self._tls.wrap_socket(accepted, server_side=True, do_handshake_on_connect=False)

    def _serve(self, connection: ClientConnection, events: int) -> None:
        try:
            if not connection.encrypted:
                if not connection.encrypt():
                    return
                connection.send(Kind.CHALLENGE, {"nonce": connection.challenge})
            if events & WRITE:
                connection.flush()
            if events & READ:
                connection.receive()
            self._handle_frames(connection)
            self._await(connection, connection.events(AHEAD_BYTES * self._max_batch if connection.authenticated else 0))
        except FencedError as error:
            self._refuse(connection, "fenced", str(error), fenced=True)
        except (MessageError, AuthenticationError) as error:
            self._refuse(connection, error.reason if isinstance(error, MessageError) else "authentication", str(error))
        except OSError:
            self._end(connection)

    def _handle_frames(self, connection: ClientConnection) -> None:
        while not connection.sending:
            max_body = 12 * self._max_batch if connection.authenticated else 0
            frame = connection.next_frame(max_body)
            if frame is None:
                return
            if connection.authenticated:
                self._handle(connection, frame)
            else:
                self._authenticate(connection, frame)

    def _await(self, connection: ClientConnection, events: int) -> None:
        if self._selector.get_key(connection.socket).events != events:
            self._selector.modify(connection.socket, events, connection)

    def _authenticate(self, connection: ClientConnection, frame: Frame) -> None:
        nonce, received = frame.meta.get("nonce"), frame.meta.get("proof")
        if frame.kind is not Kind.PROOF or not isinstance(nonce, bytes) or len(nonce) != NONCE_BYTES:
            raise AuthenticationError("no proof came")
        if not is_proof(received, proof(self._secret, b"client", connection.challenge, nonce)):
            raise AuthenticationError("the client does not know this run's secret")
        connection.nonce = nonce
        self._register_learner(connection, frame.meta.get("epoch"))
        connection.authenticated = True
        answer = proof(self._secret, b"server", nonce, connection.challenge)
        connection.send(Kind.WELCOME, {"proof": answer, "fingerprint": self._server.spec.fingerprint})

    def _register_learner(self, connection: ClientConnection, epoch: Any) -> None:
        """Only the newest learner is served, so that one which was stopped and replaced writes nothing any more."""
        if type(epoch) is not int or not 0 <= epoch < 2**62:
            raise AuthenticationError(f"{epoch!r} is no learner's epoch")
        if epoch < self._learner:
            raise FencedError(f"the learner of epoch {epoch} was replaced by {self._learner}")
        connection.epoch = epoch
        self.fence(epoch)

    def fence(self, epoch: int) -> None:
        """Serve no learner of a smaller epoch from now on."""
        self._learner = max(self._learner, epoch)
        for other in [other for other in self._connections if other.authenticated and other.epoch < epoch]:
            self._refuse(other, "fenced", f"the learner of epoch {other.epoch} was replaced by {epoch}", fenced=True)

    def _handle(self, connection: ClientConnection, frame: Frame) -> None:
        if frame.kind is Kind.SAMPLE:
            self._sample(connection, frame.meta.get("batch_size"), frame.meta.get("elsewhere"))
        elif frame.kind is Kind.PRIORITIES:
            self._priorities(frame)
        elif frame.kind is Kind.STATISTICS:
            statistics = self._server.statistics()
            sums = (statistics.count, statistics.total, statistics.total_square)
            connection.send(Kind.STATISTICS, {}, tuple(numbers.data.cast("B") for numbers in sums))
        elif frame.kind is Kind.SHARE:
            self._share(connection, frame.meta.get("batch_size"))
        elif frame.kind is Kind.EPISODE:
            self._episode(connection, frame.meta.get("serial"))
        else:
            raise MessageError("kind", f"{frame.kind.name} is not a request")

    def _share(self, connection: ClientConnection, batch_size: Any) -> None:
        """From now on its batches of that size lie in memory that it has, too, if it is on this machine."""
        self._check_batch_size(batch_size)
        if connection.socket.family != socket.AF_UNIX or connection.shared is not None:
            raise MessageError("kind", "SHARE, on a unix socket and once")
        descriptor = reserve_memory(shared_bytes(self._server.spec, batch_size))
        if descriptor is None:
            connection.send(Kind.SHARE, {})
            return
        try:
            connection.shared = SharedBatches(descriptor, self._server.spec, batch_size)
            connection.send_descriptor(Kind.SHARE, descriptor)
        finally:
            os.close(descriptor)

    def _check_batch_size(self, batch_size: Any) -> None:
        if type(batch_size) is not int or not 1 <= batch_size <= self._max_batch:
            raise MessageError("batch-size", f"{batch_size!r}, want 1 to {self._max_batch}")

    def _sample(self, connection: ClientConnection, batch_size: Any, drawn_elsewhere_steps: Any) -> None:
        self._check_batch_size(batch_size)
        if type(drawn_elsewhere_steps) is not int or not 0 <= drawn_elsewhere_steps < 2**62:
            raise MessageError("elsewhere", f"{drawn_elsewhere_steps!r}, want a number of steps")
        shared = connection.shared
        if shared is not None and shared.batch_size != batch_size:
            shared = None
        if shared is None:
            for other in self._connections:
                other.copy_pending()  # the draw takes a buffer that another client's batch may still lie in
            sample = self._server.sample(batch_size, drawn_elsewhere_steps)
        else:
            sample = self._server.sample(batch_size, drawn_elsewhere_steps, shared.rows[shared.turn])
        meta = {name: getattr(sample, name) for name in ("total_weight", "env_steps", "drawn_steps")}
        if sample.rows is None or sample.weights is None:
            connection.send(Kind.FINISHED if sample.status is SampleStatus.FINISHED else Kind.WAIT, meta)
        elif shared is None:
            connection.send(Kind.BATCH, meta, (sample.rows.view(np.uint8).data, sample.weights.data.cast("B")))
        else:
            connection.send(Kind.SHARED, meta | shared.put(sample.weights))

    def _episode(self, connection: ClientConnection, serial: Any) -> None:
        if type(serial) is not int:
            raise MessageError("serial", f"{serial!r}, want a number")
        rows = self._server.episode(serial)
        parts = () if rows is None else (rows.view(np.uint8).data,)
        connection.send(Kind.EPISODE, {"count": 0 if rows is None else len(rows)}, parts)

    def _priorities(self, frame: Frame) -> None:
        count = frame.meta.get("count")
        if type(count) is not int or count < 0 or len(frame.body) != 12 * count:
            raise MessageError("length", f"{len(frame.body)} bytes for {count!r} priorities")
        serials = np.frombuffer(frame.body, np.int64, count)
        self._server.update_priorities(serials, np.frombuffer(frame.body, np.float32, count, 8 * count))

    def _refuse(self, connection: ClientConnection, reason: str, detail: str, fenced: bool = False) -> None:
        if connection.authenticated or not self.refused[reason]:  # strangers could fill the disk by the log
            log.warning("replay socket: a client was refused: %s", detail)
        self.refused[reason] += 1
        shown = {"fenced": proof(self._secret, b"fenced", connection.nonce, connection.challenge)} if fenced else {}
        with contextlib.suppress(OSError):  # it may have gone already
            connection.send(Kind.ERROR, {"error": detail, **shown})
        self._end(connection)

    def _end_unauthenticated(self) -> None:
        """Who says nothing for long is sent away, so that strangers cannot fill the server."""
        oldest = time.monotonic() - AUTHENTICATION_SECONDS
        for connection in list(self._connections):
            if not connection.authenticated and connection.opened < oldest:
                self._refuse(connection, "silent", "no proof came in time")

    def _end(self, connection: ClientConnection) -> None:
        if connection in self._connections:
            self._connections.remove(connection)
            self._selector.unregister(connection.socket)
            connection.close()

    def close(self) -> None:
        """End all connections and remove the socket's file."""
        for connection in list(self._connections):
            self._end(connection)
        self._selector.close()
        self._listener.close()
        if self._path is not None:
            self._path.unlink(missing_ok=True)
