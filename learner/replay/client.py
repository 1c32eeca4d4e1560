"""The learner's end of the replay server's socket: two draws asked for ahead, received into fixed buffers.

Where both are on one machine, batches lie in memory that they share, and the socket only says so; a learner with pinned
buffers has them in those.

Frames are those of ``common/wire.py``. A lost connection is found again through the bus; until then, and while who
listens there proves nothing, draws answer WAIT. Statistics travel on a connection of their own, so that they never
queue behind batches.
"""

import logging
import ssl
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from rmc.common.errors import AuthenticationError, FencedError, MessageError
from rmc.common.replay import EMPTY_SAMPLE, EPISODE_BYTES, ObservationStatistics, Sample, SampleStatus
from rmc.common.shared_batches import SharedBatches
from rmc.common.window import Rows, WindowSpec
from rmc.common.wire import Kind
from rmc.learner.replay.connection import ReplayConnection

log = logging.getLogger(__name__)
AHEAD = 2  # draws in flight, so that the server gathers while the learner computes
# What a server that is gone, another that has taken its port, or an address that is none can lead to.
AWAY = (OSError, MessageError, AuthenticationError, ValueError, OverflowError)


def _totals(meta: dict[str, Any]) -> tuple[float, int, int]:
    """Total weight, env_steps and drawn_steps of an answer to a draw. Raises MessageError."""
    total_weight = meta.get("total_weight")
    if type(total_weight) is not float or not 0.0 <= total_weight < float("inf"):
        raise MessageError("total_weight", f"{total_weight!r:.80}, want a finite number from 0.0 on")
    return total_weight, _count(meta, "env_steps"), _count(meta, "drawn_steps")


def _count(meta: dict[str, Any], name: str) -> int:
    count = meta.get(name)
    if type(count) is not int or count < 0:
        raise MessageError(name, f"{count!r:.80}, want a whole number from 0 on")
    return count


class ReplayClient:
    """The Replay protocol over the server's socket.

    ``address`` gives the server's present address, or None while it has none. Raises FencedError where a newer
    learner has come; outages, and who does not know the run's secret, only make draws answer WAIT.
    """

    def __init__(
        self,
        address: Callable[[], str | None],
        secret: bytes,
        spec: WindowSpec,
        batch_size: int,
        pinned: bool = False,
        tls: ssl.SSLContext | None = None,
    ) -> None:
        self._tls = tls
        self._address, self._secret, self._spec, self._batch_size = address, secret, spec, batch_size
        body = batch_size * (spec.dtype.itemsize + 8)  # rows, then float64 weights
        tensors = [torch.empty(body, dtype=torch.uint8, pin_memory=pinned) for _ in range(AHEAD)]
        self._buffers = [tensor.numpy().data for tensor in tensors]
        self._answer = memoryview(bytearray(max(EPISODE_BYTES, spec.dtype.itemsize, 3 * 8 * spec.statistics)))
        self._turn = self._in_flight = 0
        self._last = EMPTY_SAMPLE
        self._may_share = not pinned
        self._shared: SharedBatches | None = None
        self._batches: ReplayConnection | None = None
        self._control: ReplayConnection | None = None
        self._is_away = False  # said in the log already
        self._epoch = 0

    def register_learner(self, epoch: int) -> None:
        self._epoch = epoch

    def sample(self, batch_size: int, drawn_elsewhere_steps: int = 0) -> Sample:
        """The oldest draw asked for; asks for the next. ``rows`` stay valid until the next draw but one."""
        assert batch_size == self._batch_size, (batch_size, self._batch_size)
        try:
            self._last = self._receive_sample(drawn_elsewhere_steps)
            return self._last
        except AWAY as error:
            self._drop(error)
            return self._away()

    def _away(self) -> Sample:
        """What was known last, without a batch."""
        return replace(self._last, status=SampleStatus.WAIT, rows=None, weights=None)

    def _receive_sample(self, drawn_elsewhere_steps: int) -> Sample:
        connection = self._batches = self._batches or self._open_batches()
        if connection is None:
            return self._away()
        while self._in_flight < AHEAD:
            connection.send(Kind.SAMPLE, {"batch_size": self._batch_size, "elsewhere": drawn_elsewhere_steps})
            self._in_flight += 1
        self._turn = (self._turn + 1) % AHEAD
        header, meta, body = connection.receive(self._buffers[self._turn])
        self._in_flight -= 1
        if header.kind is Kind.ERROR:
            connection.raise_error(meta)
        about = _totals(meta)
        draw, rows, weights = SampleStatus.BATCH, None, None
        if header.kind is Kind.SHARED and self._shared is not None:
            rows, weights = self._shared.take(meta)
        elif header.kind is Kind.BATCH:
            rows, weights = self._split(body)
        else:
            draw = SampleStatus.FINISHED if header.kind is Kind.FINISHED else SampleStatus.WAIT
        self._is_away = False
        return Sample(draw, rows, weights, *about)

    def _split(self, body: memoryview) -> tuple[Rows, NDArray[np.float64]]:
        split = self._batch_size * self._spec.dtype.itemsize
        if len(body) != split + 8 * self._batch_size:
            raise MessageError("length", f"{len(body)} bytes for a batch of {self._batch_size}")
        return np.frombuffer(body[:split], self._spec.dtype), np.frombuffer(body[split:], np.float64)

    def _open_batches(self) -> ReplayConnection | None:
        address = self._address()
        if address is None:
            return None
        self._in_flight = 0
        connection = self._connect(address, self._buffers[0].nbytes)
        if self._may_share and address.startswith("unix:"):
            try:
                self._shared = connection.share(self._spec, self._batch_size)
            except BaseException:
                connection.close()
                raise
        return connection

    def _drop(self, error: Exception) -> None:
        if not self._is_away:
            log.warning("the replay server is away: %s", error)
        self._is_away = True
        self.close()

    def close(self) -> None:
        """End both connections; the next draw opens them again."""
        for connection in (self._batches, self._control):
            if connection is not None:
                with suppress(OSError):
                    connection.flush()  # the last priorities, if the server reads on before it hears of the end
                connection.close()
        self._batches = self._control = None

    def update_priorities(self, serials: NDArray[np.int64], priorities: NDArray[np.float32]) -> None:
        """Send priorities back, with the next request; lost with a lost connection, as they only steer sampling."""
        if self._batches is None:
            return
        parts = (serials.tobytes(), priorities.astype(np.float32).tobytes())
        self._batches.enqueue(Kind.PRIORITIES, {"count": len(serials)}, parts)

    def statistics(self) -> ObservationStatistics | None:
        """Running observation statistics; None while the server is away."""
        counts = self._spec.counts
        try:
            body = self._ask(Kind.STATISTICS, {})
            count = np.frombuffer(body, np.int64, counts).copy()
            if (count < 0).any():
                raise MessageError("count", f"{count.min()}, want a whole number from 0 on")
            sums = np.frombuffer(body, np.float64, offset=8 * counts).reshape(2, self._spec.statistics).copy()
            return ObservationStatistics(count, *sums)
        except AWAY as error:
            log.warning("no statistics from the replay server: %s", error)
            return None

    def episode(self, serial: int) -> Rows | None:
        """The windows of one episode from its start to that one; None where not all, or the server, are there."""
        try:
            body = self._ask(Kind.EPISODE, {"serial": serial})
            return np.frombuffer(body, self._spec.dtype).copy() if len(body) else None
        except AWAY as error:
            log.warning("no episode from the replay server: %s", error)
            return None

    def _ask(self, kind: Kind, question: dict[str, Any]) -> memoryview:
        connection = self._control = self._control or self._open_control()
        try:
            if self._batches is not None:
                self._batches.flush()  # so that the answer takes into account what was sent before
            connection.send(kind, question)
            header, meta, body = connection.receive(self._answer)
            if header.kind is Kind.ERROR:
                connection.raise_error(meta)
        except (OSError, MessageError, FencedError):
            connection.close()
            self._control = None
            raise
        return body

    def _open_control(self) -> ReplayConnection:
        address = self._address()
        if address is None:
            raise ConnectionError("the replay server is not up yet")
        return self._connect(address, self._answer.nbytes)

    def _connect(self, address: str, max_body: int) -> ReplayConnection:
        return ReplayConnection(address, self._secret, self._spec.fingerprint, max_body, self._tls, self._epoch)
